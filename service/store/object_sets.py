"""A folder or an archive of meshes as a named set of objects; the layouts of YCB and EGAD are recognised."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Final

from graspd.service.cli import load_settings
from graspd.service.model.errors import InputError, LimitError
from graspd.service.model.names import fitted
from graspd.service.store.assets import MAX_FILES, UNPACK_FACTOR, unpack

#: Meshes by their file names.
SUFFIXES: Final = (".stl", ".obj", ".ply", ".off", ".glb")
#: Of several meshes of one object the first of these stems is taken: what closed and cleaned scans are called.
PREFERRED: Final = ("clean", "nontextured", "textured_simple", "textured", "collision", "visual", "raw")
#: Folders inside an object's folder that say how the mesh was made, not what it shows.
_INNER: Final = ("google_16k", "google_64k", "google_512k", "poisson", "tsdf", "clouds", "meshes", "mesh", "visual")


#: Name -> files of each object.
Objects = dict[str, dict[str, bytes]]


def files_of_set(path: Path) -> Objects | None:
    """Names and files of the objects in a folder, or in a ZIP of several; None if the path is one object.

    Raises:
        InputError: no mesh in the folder, or no readable ZIP.
        LimitError: more than the service would take in one ZIP.
    """
    if not path.is_dir() and not (path.suffix.lower() == ".zip" and path.is_file()):
        return None
    files = read_set(path, limit_bytes=UNPACK_FACTOR * load_settings().max_upload_bytes)
    # A description at the top speaks of one object, however many meshes lie around it.
    if path.is_file() and "asset.json" in files:
        return None
    found = object_set(files)
    return found if path.is_dir() or len(found) > 1 else None


def object_set(files: Mapping[str, bytes]) -> dict[str, dict[str, bytes]]:
    """Files of each object of a set.

    EGAD and the like are one folder of meshes: each is an object. YCB and the like have a folder an object, perhaps
    with folders of variants inside: the best of its meshes is taken.

    Args:
        files: relative names and contents.

    Returns:
        names of objects, sorted, each with its mesh and, if it lies beside, `asset.json`.

    Raises:
        InputError: there is no mesh.
    """
    meshes = sorted(name for name in files if PurePosixPath(name).suffix.lower() in SUFFIXES)
    if not meshes:
        raise InputError(f"no mesh among {len(files)} files; a set holds {', '.join(SUFFIXES)}")
    owners: dict[tuple[str, ...], list[str]] = {}
    for mesh in meshes:
        owners.setdefault(_owner(mesh), []).append(mesh)
    top = _common(owners)
    chosen: dict[str, str] = {}
    for owner, names in owners.items():
        is_object = len(owner) > len(top) and _variants(names)
        for name in [min(names, key=_rank)] if is_object else names:
            parts = owner[len(top) :] if is_object else (*owner[len(top) :], PurePosixPath(name).stem)
            chosen[_name("_".join(parts), chosen)] = name
    return {name: _files_of(files, mesh) for name, mesh in sorted(chosen.items())}


def read_set(path: Path, *, limit_bytes: int) -> dict[str, bytes]:
    """Files of a folder or a ZIP; links that lead out of the folder are left alone.

    Raises:
        InputError: neither a folder nor a readable ZIP.
        LimitError: more than `limit_bytes` or `MAX_FILES`.
    """
    if path.is_file():
        return unpack(path.read_bytes(), limit_bytes=limit_bytes)
    if not path.is_dir():
        raise InputError(f"{path} is neither a folder nor a ZIP of meshes")
    root, files, total = path.resolve(), dict[str, bytes](), 0
    for file in sorted(root.rglob("*")):
        wanted = file.suffix.lower() in SUFFIXES or file.name == "asset.json"
        if not wanted or not file.is_file() or not file.resolve().is_relative_to(root):
            continue
        total += file.stat().st_size
        if total > limit_bytes or len(files) >= MAX_FILES:
            raise LimitError(f"{path} holds more than {limit_bytes} bytes or {MAX_FILES} meshes; split it")
        files[file.relative_to(root).as_posix()] = file.read_bytes()
    return files


def _owner(mesh: str) -> tuple[str, ...]:
    """Folders of a mesh without those that only name a variant."""
    parts = PurePosixPath(mesh).parts[:-1]
    while len(parts) > 1 and parts[-1].lower() in _INNER:
        parts = parts[:-1]
    return parts


def _common(owners: Mapping[tuple[str, ...], list[str]]) -> tuple[str, ...]:
    """Leading folders that all share; of the single folder of one object the one above it, which can name it."""
    folders = list(owners)
    if len(folders) == 1:
        return folders[0][:-1] if _variants(owners[folders[0]]) else folders[0]
    shared = 0
    while all(len(o) > shared for o in folders) and len({o[shared] for o in folders}) == 1:
        shared += 1
    return folders[0][:shared]


def _variants(names: list[str]) -> bool:
    """Whether the meshes of a folder are one object: a single one, or names that only tell how it was made."""
    stems = [PurePosixPath(name).stem.lower() for name in names]
    return len(stems) == 1 or any(stem in PREFERRED for stem in stems)


def _rank(name: str) -> tuple[int, str]:
    stem = PurePosixPath(name).stem.lower()
    return (PREFERRED.index(stem) if stem in PREFERRED else len(PREFERRED), name)


def _name(text: str, taken: Mapping[str, str]) -> str:
    """A name the service takes, not given yet; a long one is cut, which the log tells."""
    name = fitted(re.sub(r"[^A-Za-z0-9._-]+", "_", text).lstrip("._-") or "object", 60)
    number = 2
    while name in taken:
        name, number = f"{name[:57]}-{number}", number + 1
    return name


def _files_of(files: Mapping[str, bytes], mesh: str) -> dict[str, bytes]:
    path = PurePosixPath(mesh)
    found = {path.name: files[mesh]}
    beside = str(path.parent / "asset.json")
    return found | ({"asset.json": files[beside]} if beside in files else {})
