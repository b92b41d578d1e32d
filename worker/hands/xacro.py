"""Robot from its description in any format; xacro is expanded in an isolated child process.

Expressions in xacro are Python. The child receives the hand's text files in memory, then loses access to files, network
and commands: see `worker.hands.xacro_child`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Final

from graspd.service.model.errors import HandError
from graspd.service.store.hand_files import decode_text, format_of
from graspd.worker.hands.robot import Robot
from graspd.worker.hands.urdf import MAX_BYTES, read_urdf
from graspd.worker.objects.format_check import check_format

#: CPU time limit [s]; the largest hands on arms need a tenth of it.
CPU_LIMIT_S: Final = 10
MEMORY_LIMIT_BYTES: Final = 2**30
#: Wall time limit [s], which ends a child that waits without computing.
_WALL_LIMIT_S: Final = 1800.0
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
    passed_on = {name: os.environ[name] for name in ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH") if name in os.environ}
    try:
        done = subprocess.run(
            [sys.executable, "-m", "graspd.worker.hands.xacro_child"],
            input=json.dumps(given).encode(),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=_WALL_LIMIT_S,
            check=False,
            env={**passed_on, "PYTHONHASHSEED": "0"},
        )
    except subprocess.TimeoutExpired:
        raise TimeoutError(f"{main}: expanding it did not end in {_WALL_LIMIT_S:.0f} s; try again") from None
    if done.returncode == -signal.SIGKILL:
        raise OSError(f"expanding {main} was killed; the machine may lack memory")
    try:
        answer = json.loads(done.stdout)
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
    check_format(main, files[main], HandError)
    match format_of(main, files[main]):
        case "mjcf":
            from graspd.worker.hands.mjcf import read_mjcf

            return read_mjcf(files, main)
        case "xacro":
            return read_urdf(expand_xacro(files, main, arguments or {}), main)
        case _:
            return read_urdf(files[main], main)
