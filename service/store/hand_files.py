"""The files that make a hand on the user's disk: the same ones whether it is checked, used here, or uploaded."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from service.model.errors import InputError, LimitError
from service.store.assets import MAX_FILES
from service.store.hand_main import SUFFIXES, format_of
from service.store.mesh_looks import HEAD_BYTES, MESHES, beside, named_by

#: What says more of a hand than its URDF does; the first goes over the second.
DESCRIPTIONS: Final = ("asset.json", "hand.json")
#: Of a folder only these are taken, beside its descriptions.
_TAKEN: Final = (*SUFFIXES, ".yaml", ".yml", ".stl", ".obj", ".ply", ".off", ".glb", ".dae", ".msh")
_REFERENCE: Final = re.compile(rb"""file(?:name)?\s*=\s*["']([^"']+)["']""")
_FOLDER: Final = re.compile(rb"""(?:mesh|asset)dir\s*=\s*["']([^"']*)["']""")
#: Folders of a ROS package in which descriptions lie: their meshes lie beside them, not below.
_OF_PACKAGES: Final = ("urdf", "robots", "xacro", "mjcf")
_ABOVE: Final = 4


def files_of_hand(path: Path) -> tuple[dict[str, Path], str]:
    """Relative names and places of a hand's files, and the name of its description; empty for a folder.

    Links that lead out of the hand's folder are left alone.

    Args:
        path: the folder of a hand, or its description: then the files that it names, and notes on it. Their folder is
            that of the ROS package around it, else that of the description.

    Raises:
        InputError: a folder without a description.
        LimitError: too many files.
    """
    files, main = (_of_folder(path), "") if path.is_dir() else _of_description(path)
    return files | _looks(files, path.resolve() if path.is_dir() else _package(path.resolve())), main


def _looks(files: Mapping[str, Path], root: Path) -> dict[str, Path]:
    """Material libraries and pictures that meshes name, where they lie inside the root."""
    found: dict[str, Path] = {}
    waiting = [name for name in files if name.lower().endswith(MESHES)]
    while waiting and len(files) + len(found) < MAX_FILES:
        mesh = waiting.pop()
        for reference in named_by(mesh, _head(root / mesh)):
            name = beside(mesh, reference, lambda one: _inside(root / one, root))
            if name and name not in files and name not in found:
                found[name] = root / name
                waiting += [name] if name.lower().endswith(".mtl") else []
    return found


def _head(file: Path) -> bytes:
    with file.open("rb") as opened:
        return opened.read(HEAD_BYTES)


def _of_folder(folder: Path) -> dict[str, Path]:
    root = folder.resolve()
    files = _below(root, root)
    if not any(name.lower().endswith(SUFFIXES) for name in files):
        raise InputError(f"{folder} holds no URDF, xacro or MJCF; give the folder of one hand")
    return files


def _below(folder: Path, root: Path) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for file in sorted(folder.rglob("*")):
        if (file.suffix.lower() in _TAKEN or file.name in DESCRIPTIONS) and _inside(file, root):
            files[file.relative_to(root).as_posix()] = file
            if len(files) > MAX_FILES:
                raise LimitError(f"{folder} holds more than {MAX_FILES} files; give the folder of one hand")
    return files


def _of_description(path: Path) -> tuple[dict[str, Path], str]:
    path = path.resolve() if path.is_file() else path
    root = _package(path)
    main = path.relative_to(root).as_posix()
    if path.is_file() and format_of(path.name, path.read_bytes()) == "xacro":
        # What it includes is only known when it is expanded.
        files = _below(root if (root / "package.xml").is_file() else path.parent, root)
    else:
        files = {name: root / name for name in sorted(_named_by(path, root)) if _inside(root / name, root)}
    for note in DESCRIPTIONS:
        for folder in (root, path.parent):
            if _inside(folder / note, root):
                files[note] = folder / note
    return {main: path, **files}, main


def _package(path: Path) -> Path:
    """Folder of the ROS package around a description, else the description's own."""
    for folder in list(path.parents)[:_ABOVE]:
        if (folder / "package.xml").is_file():
            return folder
    return path.parents[1] if path.parent.name in _OF_PACKAGES else path.parent


def _named_by(path: Path, root: Path, seen: frozenset[Path] = frozenset()) -> set[str]:
    """Names below the root that a description, and what it includes, may mean."""
    text = path.read_bytes()
    base = path.parent.relative_to(root).as_posix()
    folders = {"", *(match.decode(errors="replace") for match in _FOLDER.findall(text))}
    names: set[str] = set()
    for match in _REFERENCE.findall(text):
        for name in _names(match.decode(errors="replace"), base, folders):
            names.add(name)
            inner = root / name
            if inner.suffix.lower() in SUFFIXES and inner not in seen and len(seen) < 32 and _inside(inner, root):
                names |= _named_by(inner.resolve(), root, seen | {path, inner})
    return names


def _names(reference: str, base: str, folders: Iterable[str]) -> set[str]:
    """Names that a reference may mean: the folders of a ROS package, and those above it, may be there or not.

    `worker.hands.references.find_mesh` chooses among them.
    """
    scheme, separator, rest = reference.replace("\\", "/").partition("://")
    inside = (rest.lstrip("/") if scheme == "file" else rest) if separator else scheme
    if not inside or inside.startswith("/") or "\0" in inside:
        return set()
    parts = inside.split("/")
    tails = ["/".join(parts[start:]) for start in range(len(parts) if separator else 1)]
    names = {posixpath.normpath(posixpath.join(base, folder, tail)) for tail in tails for folder in folders}
    return {name for name in names | set(map(posixpath.normpath, tails)) if not name.startswith("..")}


def _inside(file: Path, root: Path) -> bool:
    return file.is_file() and file.resolve().is_relative_to(root.resolve())
