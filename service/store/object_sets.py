"""Sets of objects from a folder or ZIP of meshes or descriptions, also laid out as YCB or EGAD."""

import posixpath
import re
from collections.abc import Mapping
from itertools import chain, count
from pathlib import Path, PurePosixPath
from typing import Final

from graspd.service.cli import load_settings
from graspd.service.model.errors import InputError, LimitError
from graspd.service.model.names import shorten_name
from graspd.service.store import body_files
from graspd.service.store.assets import UNPACK_FACTOR, unpack
from graspd.service.store.usd_layers import SUFFIXES as USD

SUFFIXES: Final = (".stl", ".obj", ".ply", ".off", ".glb", *USD)
#: Suffixes of the files that are read, besides `asset.json`.
_TAKEN: Final = (*SUFFIXES, ".dae", ".msh", *body_files.SUFFIXES)
#: Limit on the files of a folder: an object of a published set has three.
_FOLDER_FILES: Final = 20_000
#: Stems of mesh files in order of preference, if an object has several meshes: closed and cleaned scans first.
PREFERRED: Final = ("clean", "nontextured", "textured_simple", "textured", "collision", "visual", "raw")
#: Names of inner folders that describe the processing of a mesh, not the object.
_INNER: Final = ("google_16k", "google_64k", "google_512k", "poisson", "tsdf", "clouds", "meshes", "mesh", "visual")

Objects = dict[str, dict[str, bytes]]


def find_set_objects(path: Path) -> Objects | None:
    """Find names and files of objects in a folder or ZIP; None if the path is a single object."""
    if not path.is_dir() and not (path.suffix.lower() == ".zip" and path.is_file()):
        return None
    files = read_set(path, limit_bytes=UNPACK_FACTOR * load_settings().max_upload_bytes)
    # With `asset.json` at its top, a ZIP is one object with any number of meshes.
    if path.is_file() and "asset.json" in files:
        return None
    found = group_objects(files)
    return found if path.is_dir() or len(found) > 1 else None


def group_objects(files: Mapping[str, bytes]) -> Objects:
    """Group the files of a set by object: sorted names, each with its mesh and `asset.json`, if any.
    A URDF, SDF or MJCF is an object with the meshes that it names, which are no objects themselves."""
    named = {name: body_files.referenced_files(files, name) for name in files if body_files.is_body(name, files[name])}
    used = {inner for main, found in named.items() for inner in found if inner != main}
    meshes = sorted(n for n in files.keys() - used if n in named or PurePosixPath(n).suffix.lower() in SUFFIXES)
    if not meshes:
        raise InputError(f"no mesh among {len(files)} files; a set holds {', '.join(SUFFIXES)}")
    owners: dict[tuple[str, ...], list[str]] = {}
    for mesh in meshes:
        owners.setdefault(_object_folder(mesh), []).append(mesh)
    top = _common_folders(owners)
    chosen: dict[str, str] = {}
    for owner, names in owners.items():
        # EGAD: each mesh of one folder is an object. YCB: each object has a folder with variants of its mesh.
        is_object = len(owner) > len(top) and _are_variants(names)
        for name in [min(names, key=_preference_key)] if is_object else names:
            parts = owner[len(top) :] if is_object else (*owner[len(top) :], PurePosixPath(name).stem)
            chosen[_unique_name("_".join(parts), chosen)] = name
    return {name: _object_files(files, mesh, named.get(mesh)) for name, mesh in sorted(chosen.items())}


def read_set(path: Path, *, limit_bytes: int) -> dict[str, bytes]:
    """Read the files of a folder or ZIP, up to `limit_bytes`; ignore links to targets outside the folder."""
    if path.is_file():
        return unpack(path.read_bytes(), limit_bytes=limit_bytes)
    root, files, total = path.resolve(), dict[str, bytes](), 0
    for file in sorted(root.rglob("*")):
        wanted = file.suffix.lower() in _TAKEN or file.name == "asset.json"
        if not wanted or not file.is_file() or not file.resolve().is_relative_to(root):
            continue
        total += file.stat().st_size
        if total > limit_bytes or len(files) >= _FOLDER_FILES:
            raise LimitError(f"{path} holds more than {limit_bytes} bytes or {_FOLDER_FILES} files; split it")
        files[file.relative_to(root).as_posix()] = file.read_bytes()
    return files


def _object_folder(mesh: str) -> tuple[str, ...]:
    parts = PurePosixPath(mesh).parts[:-1]
    while len(parts) > 1 and parts[-1].lower() in _INNER:
        parts = parts[:-1]
    return parts


def _common_folders(owners: Mapping[tuple[str, ...], list[str]]) -> tuple[str, ...]:
    """Return the common leading folders; for a single object without its own folder, which has its name."""
    folders = list(owners)
    if len(folders) == 1:
        return folders[0][:-1] if _are_variants(owners[folders[0]]) else folders[0]
    return PurePosixPath(posixpath.commonpath(["/".join(folder) for folder in folders])).parts


def _are_variants(names: list[str]) -> bool:
    """Check whether the meshes of a folder are one object: a single mesh, or names of processing steps."""
    stems = [PurePosixPath(name).stem.lower() for name in names]
    return len(stems) == 1 or any(stem in PREFERRED for stem in stems)


def _preference_key(name: str) -> tuple[int, str]:
    stem = PurePosixPath(name).stem.lower()
    return (PREFERRED.index(stem) if stem in PREFERRED else len(PREFERRED), name)


def _unique_name(text: str, taken: Mapping[str, str]) -> str:
    base = shorten_name(re.sub(r"[^A-Za-z0-9._-]+", "_", text).lstrip("._-") or "object", 60)
    numbered = (f"{base[:56]}-{number}" for number in count(2))
    return next(name for name in chain([base], numbered) if name not in taken)


def _object_files(files: Mapping[str, bytes], main: str, named: dict[str, bytes] | None) -> dict[str, bytes]:
    """Return the main file, or a description with the files that it names, and an `asset.json` beside it."""
    path = PurePosixPath(main)
    described = str(path.parent / "asset.json")
    found = {path.name: files[main]} if named is None else named
    return found | ({"asset.json": files[described]} if described in files else {})
