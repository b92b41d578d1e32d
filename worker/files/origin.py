"""Where the hand and the object of a shard come from: what a shard notes of it, and how their files are found again.

They are known by their digests, so a file that was changed or is another one is never taken for them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pydantic_core import from_json

from service.model.digests import digest_files, digest_variant
from service.model.errors import GraspdError, NotFoundError
from service.model.states import AssetKind
from service.store.assets import builtin_files, builtin_names
from service.store.columns import Attribute
from service.store.library import load_asset_files
from service.store.shards import json_attribute
from service.store.store import open_store
from worker.hands.load import files_from_path as hand_files
from worker.objects.formats import READERS
from worker.objects.prepare import files_from_path as object_files

#: What a file may be called that describes a hand or an object.
SUFFIXES: Final = {AssetKind.HAND: (".urdf", ".xml", ".zip"), AssetKind.OBJECT: (*READERS, ".zip")}
#: Files of the shard's folder, and of the folders in it, that are looked at.
LOOKED_AT: Final = 200
_FILES: Final[dict[AssetKind, Callable[[Path], tuple[str, dict[str, bytes], dict[str, Any]]]]] = {
    AssetKind.HAND: hand_files,
    AssetKind.OBJECT: object_files,
}


@dataclass(frozen=True)
class Sought:
    """A hand or an object as a shard knows it."""

    kind: AssetKind
    name: str
    digest: str
    source: str = ""
    """The path it was read from."""
    options: Mapping[str, Any] | None = None
    """What was said of it besides, such as `keep_largest`."""
    folder: Path | None = None
    """The shard's."""


@dataclass(frozen=True)
class Found:
    """Its files, and the options to read them with."""

    files: dict[str, bytes]
    options: dict[str, Any]


def remembered(hand: str, obj: str, options: Mapping[str, Any]) -> dict[str, Attribute]:
    """Root attributes that tell where hand and object were read; built-in ones need none."""
    found: dict[str, Attribute] = {}
    for kind, path in (("hand", Path(hand)), ("object", Path(obj))):
        if path.is_file():
            found[f"{kind}_source"] = str(path.resolve())
    return found | ({"object_options": json_attribute(dict(options))} if options else {})


def find(sought: Sought) -> Found:
    """The files of a hand or object: built in, at the path the shard notes, in the store, or in the shard's folder.

    Raises:
        NotFoundError: in none of these; says where it looked.
    """
    if sought.name in builtin_names(sought.kind):
        files = builtin_files(sought.kind, sought.name)
        if digest_files(sought.kind, files) == sought.digest:
            return Found(files, {})
    looked: list[str] = []
    for path in _paths(sought, looked):
        if (found := at(sought, path)) is not None:
            return found
    if (found := _stored(sought, looked)) is not None:
        return found
    for path in _beside(sought, looked):
        if (found := at(sought, path)) is not None:
            return found
    raise NotFoundError(
        f"the {sought.kind} {sought.name!r} of digest {sought.digest[:12]} is not {', not '.join(looked)}; "
        f"name its file: --{sought.kind}"
    )


def _paths(sought: Sought, looked: list[str]) -> Iterator[Path]:
    if sought.source:
        looked.append(f"at {sought.source}, where the shard was made")
        yield Path(sought.source)


def _stored(sought: Sought, looked: list[str]) -> Found | None:
    from service.settings import Settings

    url = Settings().resolved_store_url
    looked.append(f"in the store {url}")
    try:
        return Found(load_asset_files(open_store(url, make=False), sought.kind, sought.digest), {})
    except GraspdError:
        return None


def _beside(sought: Sought, looked: list[str]) -> Iterator[Path]:
    if sought.folder is None:
        return
    looked.append(f"in {sought.folder}")
    near = (path for pattern in ("*", "*/*") for path in sorted(sought.folder.glob(pattern)))
    fitting = (path for path in near if path.suffix.lower() in SUFFIXES[sought.kind])
    yield from (path for _, path in zip(range(LOOKED_AT), fitting, strict=False))


def at(sought: Sought, path: Path) -> Found | None:
    """The files at a path, if they are what is sought."""
    try:
        if not path.is_file():
            return None
        _, files, stated = _FILES[sought.kind](path)
        digest = digest_files(sought.kind, files)
    except (GraspdError, OSError):
        return None
    for options in ({}, dict(sought.options or {})):
        if digest_variant(digest, options) == sought.digest:
            return Found(files, {**stated, **options})
    return None


def options_of(attribute: object) -> dict[str, Any]:
    """Options from a shard's attribute; none where it has none."""
    try:
        said = from_json(str(attribute or "{}"))
    except ValueError:
        return {}
    return said if isinstance(said, dict) else {}
