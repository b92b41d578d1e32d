"""URDF, SDF or MJCF of an object: the description among its files, and the files that it names."""

import posixpath
from collections.abc import Mapping
from contextlib import suppress
from html import unescape
from itertools import product
from pathlib import PurePosixPath
from typing import Final

from graspd.service.model.errors import InputError
from graspd.service.store.hand_files import FOLDER, REFERENCE, decode_text, root_element
from graspd.service.store.mesh_files import resolve_mesh_reference

SUFFIXES: Final = (".urdf", ".sdf", ".mjcf", ".xml")
_ROOTS: Final = ("robot", "sdf", "mujoco")


def is_body(name: str, data: bytes) -> bool:
    """Check by suffix and root element whether a file is a URDF, SDF or MJCF."""
    return name.lower().endswith(SUFFIXES) and root_element(decode_text(data)) in _ROOTS


def find_body(files: Mapping[str, bytes]) -> str:
    """Return the only description of an object, which precedes its meshes; "" unless there is one."""
    found = [name for name in files if name.lower().endswith(SUFFIXES) and is_body(name, files[name])]
    return found[0] if len(found) == 1 else ""


def referenced_files(files: Mapping[str, bytes], main: str) -> dict[str, bytes]:
    """Return the description `main`, and the meshes and descriptions that it names, by name."""
    found, waiting = {main: files[main]}, [main]
    while waiting:
        text, base = decode_text(files[waiting.pop()]), posixpath.dirname(main)
        for written, folder in product(REFERENCE.findall(text), {"", *FOLDER.findall(text)}):
            with suppress(InputError):
                for name in resolve_mesh_reference(posixpath.join(unescape(folder), unescape(written)), base).names:
                    if name in files and name not in found:
                        found[name] = files[name]
                        waiting += [name] if PurePosixPath(name).suffix.lower() in SUFFIXES else []
    return found
