"""Files of an asset from an upload: one file, or a ZIP of a folder (hands and objects only)."""

import io
import json
import re
from collections.abc import Mapping, MutableMapping
from pathlib import PurePosixPath
from typing import IO, Final

from graspd.service.model.errors import InputError, LimitError
from graspd.service.model.names import check_name_length
from graspd.service.model.states import AssetKind
from graspd.service.store.assets import UNPACK_FACTOR, ZipFiles, asset_json, check_path
from graspd.service.store.body_files import SUFFIXES as BODIES
from graspd.service.store.body_files import find_body
from graspd.service.store.descriptions import parse_json_object
from graspd.service.store.hand_files import SUFFIXES, find_main_file, hand_name
from graspd.service.store.network_file import NETWORK_FILE, check_size
from graspd.service.store.usd_layers import SUFFIXES as USD

MAIN_SUFFIXES: Final[dict[AssetKind, tuple[str, ...]]] = {
    AssetKind.HAND: SUFFIXES,
    AssetKind.OBJECT: (".stl", ".obj", ".ply", ".glb", ".gltf", ".off", *USD, *BODIES),
    AssetKind.NETWORK: (".npz",),
}
_NAME: Final = re.compile(r"[^A-Za-z0-9._-]+")


def files_of_upload(
    kind: AssetKind, filename: str, data: bytes | IO[bytes], *, limit_bytes: int, options: str = ""
) -> MutableMapping[str, bytes]:
    """Return the files of an uploaded asset, including `asset.json`; `options` override keys of this file."""
    leaf = PurePosixPath(filename.replace("\\", "/")).name
    suffix = PurePosixPath(leaf).suffix.lower()
    file = io.BytesIO(data) if isinstance(data, bytes) else data
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    if size > limit_bytes:
        raise LimitError(f"{leaf} is larger than {limit_bytes} bytes; simplify it or raise the limit")
    if not leaf or not size:
        raise InputError(f"the upload {leaf or 'without a name'} is empty; choose a file with content")
    if kind is AssetKind.NETWORK:
        # An .npz is a ZIP itself, so it is not unpacked.
        if suffix not in MAIN_SUFFIXES[kind]:
            raise InputError(f"{leaf} is no network; upload an .npz file")
        check_size(size, leaf)
        files: MutableMapping[str, bytes] = {NETWORK_FILE: file.read()}
    elif suffix == ".zip":
        files = ZipFiles(file, limit_bytes=limit_bytes * UNPACK_FACTOR).strip_common_folder()
    else:
        files = {check_path(leaf): file.read()}
    stated = "asset.json" in files
    said = parse_json_object(asset_json(files), "asset.json") if stated else {}
    described = said | (parse_json_object(options, "options") if options else {})
    if kind is AssetKind.HAND and isinstance(wanted := described.get("file", ""), str):
        described["file"] = find_main_file(files, wanted, where=leaf)
    elif not stated:
        described.setdefault("file", _main_file(kind, leaf, files))
    if described != said:
        files["asset.json"] = json.dumps(described).encode()
    return files


def name_of_upload(filename: str) -> str:
    """Derive a valid asset name: `My mug (2).stl` becomes `My-mug-2`; raise InputError if it is too long."""
    leaf = PurePosixPath(filename.replace("\\", "/")).name
    stem = hand_name(leaf) if leaf.lower().endswith(SUFFIXES) else PurePosixPath(leaf).stem
    return check_name_length(_NAME.sub("-", stem).strip("-._") or "unnamed")


def _main_file(kind: AssetKind, upload: str, files: Mapping[str, bytes]) -> str:
    suffixes = MAIN_SUFFIXES[kind]
    if body := find_body(files):
        return body
    # Other XML files, such as a licence, are no meshes.
    meshes = tuple(suffix for suffix in suffixes if suffix not in BODIES)
    found = [name for name in sorted(files) if PurePosixPath(name).suffix.lower() in meshes]
    if not found:
        known = ", ".join(suffixes)
        raise InputError(f"{upload} holds no {kind.value} file; upload one of {known}, or a ZIP of the folder")
    if len(found) > 1:
        names = ", ".join(found[:5])
        raise InputError(f'{upload} holds several {kind.value} files ({names}); add an asset.json with {{"file": ...}}')
    return found[0]
