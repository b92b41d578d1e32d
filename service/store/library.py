"""Library of hands and objects in the store: publishing, loading, names."""

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
from graspd.service.store.assets import builtin_asset, builtin_model, builtin_names, create_asset, pack_into, unpack
from graspd.service.store.integrity import add_seal, get_document, is_sealed, seal_archive
from graspd.service.store.records import Put, put_record, read_record
from graspd.service.store.store import Store

log = logging.getLogger(__name__)
#: Size limit of an unpacked archive [bytes], in case the store was manipulated; uploads have another limit.
UNPACKED_LIMIT_BYTES: Final = 2 * 2**30


def publish_asset(
    store: Store, kind: AssetKind, name: str, files: Mapping[str, bytes], said: Mapping[str, object] | None = None
) -> Asset:
    """Store the archive and then the record of a hand or object; a repeated call changes nothing."""
    return record_asset(store, store_files(store, kind, name, files, said))


def store_files(
    store: Store, kind: AssetKind, name: str, files: Mapping[str, bytes], said: Mapping[str, object] | None = None
) -> Asset:
    """Store the archive of an asset, which readers do not see yet; InputError for an invalid `asset.json`.

    `said` are further fields of the record. Private files include the mark of their project (`model.projects`).
    """
    asset = create_asset(kind, name, files, created=timestamp()).model_copy(update=dict(said or {}))
    with tempfile.TemporaryFile() as archive:
        pack_into(files, archive)
        seal_archive(archive)
        key = names.asset_key(kind, asset.digest, "files.zip")
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
    """Write the record, by `put` if given; ConflictError for known content with another name or deletion."""
    record = names.asset_key(asset.kind, asset.digest, "asset.json")
    is_new = put(record, asset) if put is not None else put_record(store, record, asset)
    if store.exists(names.deletion_key(asset.kind.value, asset.digest)):
        if is_new:
            store.delete(record)
        raise ConflictError(f"the same {asset.kind.value} was deleted and is being removed; try again in a moment")
    if is_new:
        return asset
    known = load_asset(store, asset.kind, asset.digest)
    if known.name != asset.name:
        raise ConflictError(f"this {asset.kind.value} is already known as {known.name!r}; use that name")
    return known


def builtin_assets() -> list[Asset]:
    return [builtin_asset(kind, name)[0] for kind in AssetKind for name in builtin_names(kind)]


def publish_builtins(store: Store) -> list[Asset]:
    """Publish all built-in assets and their models; log and omit damaged records."""
    published = []
    for kind, name in [(one, name) for one in AssetKind for name in builtin_names(one)]:
        asset, files = builtin_asset(kind, name)
        try:
            published.append(publish_asset(store, kind, name, files, {"builtin": True, "created": asset.created}))
        except DamagedError as error:
            log.warning("the built-in %s %s cannot be used: %s", kind.value, name, error)
        key = names.asset_key(kind, asset.digest, "model.glb")
        model = add_seal(key, builtin_model(kind, name))
        # The model depends on code and asset: a model of an older version is replaced.
        if not store.put(key, model) and store.get(key) != model:
            store.delete(key)
            store.put(key, model)
    return published


def stored_assets(store: Store) -> list[tuple[AssetKind, str]]:
    records = [entry.key.split("/") for entry in store.list(names.ASSETS)]
    gone = {entry.key for entry in store.list(names.DELETIONS)}
    # Other files of an asset may have deeper keys, such as the convex pieces of an object.
    found = [key for key in records if len(key) == 4 and key[1] in set(AssetKind) and key[3] == "asset.json"]
    return [(AssetKind(key[1]), key[2]) for key in found if names.deletion_key(key[1], key[2]) not in gone]


def load_asset(store: Store, kind: AssetKind, digest: str) -> Asset:
    return read_record(Asset, store, names.asset_key(kind, digest, "asset.json"))


def load_asset_files(store: Store, kind: AssetKind, digest: str) -> dict[str, bytes]:
    """Load all files of a hand or object; InputError if they do not match the digest."""
    files = unpack(store.get(names.asset_key(kind, digest, "files.zip")), limit_bytes=UNPACKED_LIMIT_BYTES)
    if digest_files(kind, files) != digest:
        raise InputError(f"the archive of {kind.value} {digest} in the store is damaged; upload it again")
    return files


def load_check(store: Store, kind: AssetKind, digest: str) -> dict[str, object] | None:
    """Load the report of ingest (`verdict`, `message`, `repairs`, `facts`); None before its end."""
    key = names.asset_key(kind, digest, "check.json")
    if not store.exists(key):
        return None
    with contextlib.suppress(DamagedError):
        found = get_document(store, key)
        if found.get("verdict") in ("accept", "repair", "refuse"):
            return found
    raise DamagedError(f"the record {key} in the store is damaged; remove it, and the {kind.value} is checked again")
