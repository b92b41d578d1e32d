"""The files that make a hand on the user's disk: the same ones whether it is checked, used here, or uploaded."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Final

from service.model.errors import InputError, LimitError
from service.store.assets import MAX_FILES

#: What says more of a hand than its URDF does; the first goes over the second.
DESCRIPTIONS: Final = ("asset.json", "hand.json")
#: Of a folder only these are taken, beside its descriptions.
_SUFFIXES: Final = (".urdf", ".xml", ".stl", ".obj", ".ply", ".off", ".glb")
_REFERENCE: Final = re.compile(rb"""filename\s*=\s*["']([^"']+)["']""")


def files_of_hand(path: Path) -> dict[str, Path]:
    """Relative names and places of a hand's files; links that lead out of its folder are left alone.

    Args:
        path: the folder of a hand, or its URDF: then of its folder what the URDF names, and the descriptions.

    Raises:
        InputError: a folder without a URDF.
        LimitError: too many files.
    """
    return _of_folder(path) if path.is_dir() else _of_urdf(path)


def _of_folder(folder: Path) -> dict[str, Path]:
    root = folder.resolve()
    files = {
        file.relative_to(root).as_posix(): file
        for file in sorted(root.rglob("*"))
        if (file.suffix.lower() in _SUFFIXES or file.name in DESCRIPTIONS) and _inside(file, root)
    }
    if not any(name.lower().endswith((".urdf", ".xml")) for name in files):
        raise InputError(f"{folder} holds no URDF; give the folder of one hand")
    if len(files) > MAX_FILES:
        raise LimitError(f"{folder} holds {len(files)} files; at most {MAX_FILES} are taken")
    return files


def _of_urdf(path: Path) -> dict[str, Path]:
    root = path.parent.resolve()
    named = {name for match in _REFERENCE.findall(path.read_bytes()) for name in _names(match.decode(errors="replace"))}
    files = {name: root / name for name in sorted(named | set(DESCRIPTIONS)) if _inside(root / name, root)}
    return {path.name: path, **files}


def _names(reference: str) -> set[str]:
    """Relative names that a reference may mean: the folder of a ROS package may be there or not."""
    inside = reference.partition("://")[2] or reference
    names = {inside, inside.partition("/")[2] if "://" in reference else ""}
    return {posixpath.normpath(name) for name in names if name and not name.startswith("/") and "\0" not in name}


def _inside(file: Path, root: Path) -> bool:
    return file.is_file() and file.resolve().is_relative_to(root)
