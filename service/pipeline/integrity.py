"""Integrity check of a store: shards, records and uploads against their checksums. Changes nothing."""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Callable, Iterator
from typing import Any, Final

from graspd.service.index.notes import Damage
from graspd.service.model import names
from graspd.service.model.clock import age_of
from graspd.service.model.digests import digest_files
from graspd.service.model.domain import Asset
from graspd.service.model.errors import DamagedError, InputError, NotFoundError
from graspd.service.model.records import (
    AttemptRecord,
    DatasetEvent,
    DatasetRecord,
    JobEvent,
    JobRecord,
    ObjectSet,
    Snapshot,
    Tag,
)
from graspd.service.model.states import AssetKind, Stage
from graspd.service.model.webhooks import Webhook
from graspd.service.store.assets import ZipFiles
from graspd.service.store.integrity import is_sealed
from graspd.service.store.library import UNPACKED_LIMIT_BYTES, load_check
from graspd.service.store.manifests import ShardManifest
from graspd.service.store.records import CHARTS, IN_SCENES, STABILITY, DeletedJob, Deletion, parse_record
from graspd.service.store.store import Store

#: Key patterns of records, and the model of each.
_RECORDS: Final[tuple[tuple[str, type[Any]], ...]] = (
    (r"assets/[^/]+/[^/]+/asset\.json", Asset),
    (r"jobs/[^/]+/job\.json", JobRecord),
    (r"jobs/[^/]+/events/[^/]+\.json", JobEvent),
    (r"tasks/[^/]+/attempts/[^/]+\.json", AttemptRecord),
    (r"datasets/[^/]+/dataset\.json", DatasetRecord),
    (r"datasets/[^/]+/events/[^/]+\.json", DatasetEvent),
    (r"datasets/[^/]+/snapshots/[^/]+\.json", Snapshot),
    (r"object_sets/[^/]+/[^/]+\.json", ObjectSet),
    (r"deletions/[^/]+/[^/]+\.json", Deletion),
    (r"released/[^/]+\.json", DeletedJob),
    (r"webhooks/[^/]+\.json", Webhook),
    (r"tags/[^/]+/[^/]+\.json", Tag),
)
#: Folders in the order of a scan, which stores its position.
FOLDERS: Final = (
    names.SHARDS,
    names.ASSETS,
    names.JOBS,
    names.TASKS,
    names.DATASETS,
    names.OBJECT_SETS,
    names.DELETIONS,
    names.RELEASED,
    names.WEBHOOKS,
    names.TAGS,
    CHARTS,
    IN_SCENES,
    STABILITY,
    names.MARKS,
    names.SERVICE,
    names.REMOVED,
)
_SEALED: Final = (".json", ".zip", ".npz", ".glb")
_UPLOAD: Final = re.compile(r"assets/(hand|object|network)/([0-9a-f]{32})/(files\.zip|check\.json)")
_SHARD: Final = re.compile(r"shards/(base|scene|views)/([0-9a-f]{32})\.(h5|json)")
STAGES: Final = {kind: stage for stage, kind in names.SHARD_KINDS.items()}

MISSING: Final = "its file is missing"
NO_MANIFEST: Final = "it has no manifest"
BAD_MANIFEST: Final = "its manifest is damaged"
FOREIGN: Final = "graspd did not write it"
#: Time for which a file may lack its manifest [s].
_ON_ITS_WAY_S: Final = 60.0
Read = Callable[[int], object]
#: Called with the key of each object that was written without a checksum.
Unsealed = Callable[[str], None]


def scan(
    store: Store, *folders: str, read: Read = lambda size: None, unsealed: Unsealed = lambda key: None
) -> Iterator[tuple[str, Damage | None]]:
    """Yield every checkable object of all or some folders, with its damage or None."""
    for folder in folders or FOLDERS:
        for entry in store.list(folder):
            if is_checked(entry.key):
                yield entry.key, examine(store, entry.key, read=read, unsealed=unsealed)


def may_await_manifest(store: Store, one: Damage) -> bool:
    """Check whether a recent file may still lack its manifest, which its worker writes next."""
    try:
        return one.what == NO_MANIFEST and (age_of(store.stamp(one.key)[1]) or 0.0) < _ON_ITS_WAY_S
    except NotFoundError:
        return True


def is_checked(key: str) -> bool:
    return key.startswith(f"{names.SHARDS}/") or key.endswith(_SEALED)


def examine(
    store: Store, key: str, *, read: Read = lambda size: None, unsealed: Unsealed = lambda key: None
) -> Damage | None:
    """Return the damage of one object or None; the file of a shard is checked with its manifest."""
    try:
        if not key.startswith(f"{names.SHARDS}/"):
            return _check_sealed(store, key, read, unsealed)
        if (match := _SHARD.fullmatch(key)) is None:
            return Damage(key, FOREIGN) if store.exists(key) else None
        kind, shard, ending = match.groups()
        if ending == "json":
            return _manifest(store, key, STAGES[kind], shard, read, unsealed)
        manifest = names.shard_manifest(STAGES[kind], shard)
        # A worker writes the manifest last; it may have arrived since the listing.
        orphan = not store.exists(manifest) and store.exists(key) and not store.exists(manifest)
        return Damage(key, NO_MANIFEST, shard) if orphan else None
    except NotFoundError:
        return None  # The object was removed after the listing.


def _check_sealed(store: Store, key: str, read: Read, unsealed: Unsealed) -> Damage | None:
    """Check an object by its own checksum; without a checksum, check its content as far as possible."""
    match = _UPLOAD.fullmatch(key)
    model = next((model for pattern, model in _RECORDS if re.fullmatch(pattern, key)), None)
    try:
        if not is_sealed(key, _count_bytes(store.stream(key), read), store.size(key)):
            unsealed(key)
            if match is not None and match[3] == "files.zip":
                _check_upload(store, key, AssetKind(match[1]), match[2])
        if model is not None:
            parse_record(model, store.get(key), key)
        elif match is not None and match[3] == "check.json":
            load_check(store, AssetKind(match[1]), match[2])
    except DamagedError as error:
        return Damage(key, str(error))
    return None


def _count_bytes(chunks: Iterator[bytes], read: Read) -> Iterator[bytes]:
    for chunk in chunks:
        read(len(chunk))
        yield chunk


def _check_upload(store: Store, key: str, kind: AssetKind, digest: str) -> None:
    """Check an archive of graspd 0.2 by the digest of its files, which names its folder."""
    with tempfile.TemporaryFile() as file:
        file.writelines(store.stream(key))
        try:
            found = digest_files(kind, ZipFiles(file, limit_bytes=UNPACKED_LIMIT_BYTES))
        except InputError as error:
            raise DamagedError(f"{key} in the store is damaged: {error}") from None
    if found != digest:
        raise DamagedError(f"{key} in the store is damaged: its files do not match its name; upload it again")


def _manifest(store: Store, key: str, stage: Stage, shard: str, read: Read, unsealed: Unsealed) -> Damage | None:
    try:
        data = store.get(key)
        manifest = parse_record(ShardManifest, data, key)
    except DamagedError:
        return Damage(key, BAD_MANIFEST, shard)
    if not is_sealed(key, [data], len(data)):
        unsealed(key)
    file = names.shard_file(stage, shard)
    if (manifest.shard_id, manifest.key) != (shard, file):
        return Damage(key, BAD_MANIFEST, shard)
    try:
        if (size := store.size(file)) != manifest.size_bytes:
            return Damage(file, f"it has {size} bytes, expected {manifest.size_bytes}", shard)
        digest = hashlib.sha256()
        for chunk in store.stream(file):
            digest.update(chunk)
            read(len(chunk))
    except NotFoundError:
        return Damage(file, MISSING, shard) if store.exists(key) else None
    if digest.hexdigest() != manifest.sha256:
        return Damage(file, f"its SHA-256 is {digest.hexdigest()[:12]}..., expected {manifest.sha256[:12]}...", shard)
    return None
