"""Robot from its description in any format; xacro is expanded in an isolated child process.

Expressions in xacro are Python. The child receives the hand's text files in memory, then loses access to files, network
and commands: see `worker.hands.xacro_child`."""

import json
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Final

from graspd.service.model.errors import HandError
from graspd.service.store.hand_files import decode_text, format_of
from graspd.service.store.usd_layers import SUFFIXES as USD
from graspd.worker.hands.robot import Robot
from graspd.worker.hands.urdf import MAX_BYTES, read_urdf
from graspd.worker.objects.format_check import check_format
from graspd.worker.objects.isolation import run_isolated

#: CPU time limit [s]; the largest hands on arms need a tenth of it.
CPU_LIMIT_S: Final = 10
MEMORY_LIMIT_BYTES: Final = 2**30
#: Suffixes of files that an expansion may read; of other files it gets only the names.
_READ: Final = (".xacro", ".urdf", ".xml", ".yaml", ".yml")


def expand_xacro(files: Mapping[str, bytes], main: str, arguments: Mapping[str, str]) -> bytes:
    """Expand a xacro file to a URDF, with values of its `<xacro:arg>`.
    Includes and `$(find PACKAGE)` are searched among the hand's files only. Raises HandError: the file cannot be
    expanded, or refers to files outside the hand's folder. OSError: the child process was killed or hung."""
    given = {
        "main": main,
        "arguments": dict(arguments),
        "names": sorted(files),
        "memory": MEMORY_LIMIT_BYTES,
        "cpu": CPU_LIMIT_S,
        "limit": MAX_BYTES,
        "texts": {
            name: decode_text(files[name]) for name in sorted(files) if PurePosixPath(name).suffix.lower() in _READ
        },
    }
    done = run_isolated("graspd.worker.hands.xacro_child", data=json.dumps(given).encode(), what=main)
    try:
        answer = json.loads(done)
        urdf, error = answer["urdf"], answer["error"]
    except (ValueError, KeyError, TypeError):
        raise HandError(
            f"{main}: expanding it takes more than {CPU_LIMIT_S} s or {MEMORY_LIMIT_BYTES >> 20} MiB; "
            "expand it yourself and give the URDF"
        ) from None
    if error:
        raise HandError(f"{main}: {error}")
    return str(urdf).encode()


def read_robot(files: Mapping[str, bytes], main: str, arguments: Mapping[str, str] | None = None) -> Robot:
    """Read and check the description `main` among a hand's files; its root element determines the format."""
    if main.lower().endswith(USD):
        from graspd.worker.hands.usd import read_usd

        return read_usd(files, main)
    check_format(main, files[main], HandError)
    match format_of(main, files[main]):
        case "mjcf":
            from graspd.worker.hands.mjcf import read_mjcf

            return read_mjcf(files, main)
        case "xacro":
            return read_urdf(expand_xacro(files, main, arguments or {}), main)
        case _:
            return read_urdf(files[main], main)
