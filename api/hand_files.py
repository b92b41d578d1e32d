"""A hand on the user's disk as one upload: a folder, or a URDF with the meshes that it names, packed into a ZIP."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from service.assets import MAX_FILES, pack
from service.errors import InputError, LimitError

#: Of a folder only these are sent.
_SUFFIXES: Final = (".urdf", ".xml", ".stl", ".obj", ".ply", ".off", ".glb")
_REFERENCE: Final = re.compile(rb"""filename\s*=\s*["']([^"']+)["']""")


@contextmanager
def upload_of(path: Path) -> Iterator[Path]:
    """The file to send: the path itself, or a ZIP of what belongs to it, removed afterwards.

    Raises:
        InputError: a folder without a URDF, or with several and no asset.json.
        LimitError: too many files.
    """
    files = _folder(path) if path.is_dir() else _urdf(path)
    if len(files) <= 1:
        yield path
        return
    with TemporaryDirectory(prefix="graspd-hand-") as folder:
        # The file's name is the hand's, unless the user says another.
        archive = Path(folder) / f"{path.resolve().stem}.zip"
        archive.write_bytes(pack({name: file.read_bytes() for name, file in files.items()}))
        yield archive


def _folder(folder: Path) -> dict[str, Path]:
    root = folder.resolve()
    files = {
        file.relative_to(root).as_posix(): file
        for file in sorted(root.rglob("*"))
        if (file.suffix.lower() in _SUFFIXES or file.name == "asset.json")
        and file.is_file()
        and file.resolve().is_relative_to(root)
    }
    if not any(name.lower().endswith((".urdf", ".xml")) for name in files):
        raise InputError(f"{folder} holds no URDF; give the folder of one hand")
    if len(files) > MAX_FILES:
        raise LimitError(f"{folder} holds {len(files)} files; at most {MAX_FILES} are taken")
    return files


def _urdf(path: Path) -> dict[str, Path]:
    """A URDF and those of the files it names that lie in its folder; nothing for any other file."""
    if path.suffix.lower() not in (".urdf", ".xml") or not path.is_file():
        return {}
    root = path.parent.resolve()
    files = {path.name: path}
    for match in _REFERENCE.findall(path.read_bytes()):
        reference = match.decode(errors="replace")
        inside = reference.partition("://")[2] or reference
        for name in (inside, inside.partition("/")[2] if "://" in reference else ""):
            target = root / name
            if name and target.is_file() and target.resolve().is_relative_to(root):
                files[target.resolve().relative_to(root).as_posix()] = target
    beside = root / "asset.json"
    return files | ({"asset.json": beside} if beside.is_file() and len(files) > 1 else {})
