"""The files that make a hand on the user's disk: the same ones whether it is checked, used here, or uploaded."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from html import unescape
from pathlib import Path, PurePosixPath
from typing import Final

from service.model.errors import InputError, LimitError
from service.store.assets import MAX_FILES
from service.store.hand_main import SUFFIXES, format_of, text_of
from service.store.mesh_looks import HEAD_BYTES, MESHES, beside, named_by
from service.store.mesh_names import one_like, read_reference

#: What says more of a hand than its URDF does; the first goes over the second.
DESCRIPTIONS: Final = ("asset.json", "hand.json")
#: Of a folder only these are taken, beside its descriptions.
_TAKEN: Final = (*SUFFIXES, ".yaml", ".yml", ".stl", ".obj", ".ply", ".off", ".glb", ".dae", ".msh")
_REFERENCE: Final = re.compile(r"""file(?:name)?\s*=\s*["']([^"']+)["']""")
_FOLDER: Final = re.compile(r"""(?:mesh|asset)dir\s*=\s*["']([^"']*)["']""")
_MAX_INCLUDED: Final = 32
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
        files = {name: root / name for name in sorted(_named_by(path, root))}
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


def _named_by(path: Path, root: Path) -> set[str]:
    """Names of the files below the root that a description, and what it includes, may mean.

    `worker.hands.references.find_mesh` and `worker.hands.mjcf_source` choose among them.
    """
    seen, waiting = {path}, [path]
    bases, folders, references = set(), {""}, set()
    found: set[str] = set()
    while waiting:
        file = waiting.pop()
        text = text_of(file.read_bytes())
        bases.add(file.parent.relative_to(root).as_posix())
        folders |= {unescape(folder) for folder in _FOLDER.findall(text)}
        references |= {unescape(reference) for reference in _REFERENCE.findall(text)}
        # Names in an included file count from its folder or from that of the description, as the reader pleases.
        found = {
            name
            for reference in references
            for base in bases
            for folder in folders
            for name in _names(reference, base, folder, root)
        }
        for name in sorted(found):
            inner = (root / name).resolve()
            if inner.suffix.lower() in SUFFIXES and inner not in seen and len(seen) < _MAX_INCLUDED:
                seen.add(inner)
                waiting.append(inner)
    return found


def _names(written: str, base: str, folder: str, root: Path) -> Iterator[str]:
    """Names of files below the root that a reference may mean."""
    with suppress(InputError):
        reference = read_reference(posixpath.join(folder, written), base)
        if not reference.scheme or not folder:
            for name in reference.names:
                if there := _on_disk(name, root):
                    yield there


def _on_disk(name: str, root: Path) -> str:
    """The name of a file below the root, in its own capitals; empty where there is none."""
    if _inside(root / name, root):
        return posixpath.normpath(name)
    at = root
    for part in PurePosixPath(name).parts:
        like = part if (at / part).exists() else one_like(part, (e.name for e in _entries(at)))
        if not like:
            return ""
        at /= like
    return at.relative_to(root).as_posix() if _inside(at, root) else ""


def _entries(folder: Path) -> Iterable[Path]:
    try:
        return list(folder.iterdir()) if folder.is_dir() else []
    except OSError:
        return []


def _inside(file: Path, root: Path) -> bool:
    return file.is_file() and file.resolve().is_relative_to(root.resolve())
