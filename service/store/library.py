"""Hands and objects in the store: publish, load, and the names they go by."""

from __future__ import annotations

import contextlib
import logging
import tempfile
from collections.abc import Mapping
from typing import Final

from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_files
from graspd.service.model.domain import Asset
from graspd.service.model.errors import ConflictError, DamagedError, InputError
from graspd.service.model.states import AssetKind
from graspd.service.store.assets import builtin_asset, builtin_model, builtin_names, describe, pack_into, unpack
from graspd.service.store.integrity import get_document, is_sealed, seal_archive, sealed
from graspd.service.store.records import Put, put_record, read_record
from graspd.service.store.store import Store

log = logging.getLogger(__name__)
#: An archive the service packed itself is bounded by the upload limit; this only stops a store that was tampered with.
UNPACKED_LIMIT_BYTES: Final = 2 * 2**30


def publish_asset(
    store: Store,
    kind: AssetKind,
    name: str,
    files: Mapping[str, bytes],
    *,
    builtin: bool = False,
    created: str = "",
    owner: str = "",
) -> Asset:
    """Put a hand or object into the store: the archive first, its record last. Doing it twice changes nothing.

    Args:
        files: `asset.json` (names the main file) and all files it needs.
        owner: id of the API key that uploads it.

    Raises:
        InputError: `asset.json` is missing or wrong.
        ConflictError: the same content is known under another name.
    """
    asset = store_files(store, kind, name, files, builtin=builtin, created=created, said={"owner": owner})
    return record_asset(store, asset)


def store_files(
    store: Store,
    kind: AssetKind,
    name: str,
    files: Mapping[str, bytes],
    *,
    builtin: bool = False,
    created: str = "",
    said: Mapping[str, object] | None = None,
) -> Asset:
    """The first half of `publish_asset`: the archive is there, and nothing counts it yet.

    Args:
        said: further fields of the record: `owner`, `project`, `shared`, `self_test`. Files that their project keeps
            to itself hold its mark (`service.model.projects.marks_of`).

    Raises:
        InputError: `asset.json` is missing or wrong.
    """
    asset = describe(kind, name, files, created=created or timestamp(), builtin=builtin)
    asset = asset.model_copy(update=dict(said or {}))
    with tempfile.TemporaryFile() as archive:
        pack_into(files, archive)
        seal_archive(archive)
        key = names.asset_files(kind, asset.digest)
        if not store.put_file(key, archive) and _is_damaged(store, key):
            store.set_aside(key)
            store.put_file(key, archive)
    return asset


def _is_damaged(store: Store, key: str) -> bool:
    try:
        is_sealed(key, store.stream(key), store.size(key))
    except DamagedError:
        return True
    return False


def record_asset(store: Store, asset: Asset, put: Put | None = None) -> Asset:
    """The second half of `publish_asset`: the record, from which on the asset counts.

    Args:
        put: writes the record; None: into this store.

    Raises:
        ConflictError: the same content is known under another name, or is being removed.
    """
    record = names.asset_record(asset.kind, asset.digest)
    new = put(record, asset) if put is not None else put_record(store, record, asset)
    if store.exists(names.deletion(asset.kind.value, asset.digest)):
        if new:
            store.delete(record)
        raise ConflictError(f"the same {asset.kind.value} of before is still being removed; try again in a moment")
    if new:
        return asset
    known = load_asset(store, asset.kind, asset.digest)
    if known.name != asset.name:
        raise ConflictError(f"this {asset.kind.value} is already known as {known.name!r}; use that name")
    return known


def builtin_assets() -> list[Asset]:
    """The hands and objects that come with graspd."""
    return [builtin_asset(kind, name)[0] for kind in AssetKind for name in builtin_names(kind)]


def publish_builtins(store: Store) -> list[Asset]:
    """Put the hands and objects that come with graspd into the store."""
    published = []
    for kind in AssetKind:
        for name in builtin_names(kind):
            asset, files = builtin_asset(kind, name)
            try:
                published.append(publish_asset(store, kind, name, files, builtin=True, created=asset.created))
            except DamagedError as error:
                log.warning("the built-in %s %s cannot be used: %s", kind.value, name, error)
            _put_model(store, names.asset_model(kind, asset.digest), builtin_model(kind, name))
    return published


def _put_model(store: Store, key: str, model: bytes) -> None:
    """A picture follows from the program as well as from the asset: one of an older version is replaced."""
    model = sealed(key, model)
    if not store.put(key, model) and store.get(key) != model:
        store.delete(key)
        store.put(key, model)


def stored_assets(store: Store) -> list[tuple[AssetKind, str]]:
    """Kind and digest of every hand and object in the store, but for those that were deleted."""
    records = [entry.key.split("/") for entry in store.list(names.ASSETS)]
    gone = {entry.key for entry in store.list(names.DELETIONS)}
    # Other files of an asset may lie deeper, such as an object's convex pieces.
    found = [key for key in records if len(key) == 4 and key[1] in set(AssetKind) and key[3] == "asset.json"]
    return [(AssetKind(key[1]), key[2]) for key in found if names.deletion(key[1], key[2]) not in gone]


def load_asset(store: Store, kind: AssetKind, digest: str) -> Asset:
    """The record of a hand or object; NotFoundError if there is none, DamagedError if it is not what its name says."""
    return read_record(Asset, store, names.asset_record(kind, digest))


def load_asset_files(store: Store, kind: AssetKind, digest: str) -> dict[str, bytes]:
    """All files of a hand or object, checked against its digest.

    Raises:
        NotFoundError: no such asset.
        InputError: the archive in the store is not what its name says.
    """
    files = unpack(store.get(names.asset_files(kind, digest)), limit_bytes=UNPACKED_LIMIT_BYTES)
    if digest_files(kind, files) != digest:
        raise InputError(f"the archive of {kind.value} {digest} in the store is damaged; upload it again")
    return files


def load_check(store: Store, kind: AssetKind, digest: str) -> dict[str, object] | None:
    """What ingest found (`verdict`, `message`, `repairs`, `facts`); None while it has not run.

    Raises:
        DamagedError: the record is not what its name says.
    """
    key = names.asset_check(kind, digest)
    if not store.exists(key):
        return None
    with contextlib.suppress(DamagedError):
        found = get_document(store, key)
        if found.get("verdict") in ("accept", "repair", "refuse"):
            return found
    raise DamagedError(f"the record {key} in the store is damaged; remove it, and the {kind.value} is checked again")
