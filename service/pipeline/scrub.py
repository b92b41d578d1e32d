"""Looks through a store for what is not what it was: shards, manifests, records. Reads everything, changes nothing."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator
from typing import Any, Final

from pydantic import ValidationError

from service.index.damage import Damage
from service.model import names
from service.model.clock import age_of
from service.model.dataset_records import DatasetEvent, DatasetRecord, ObjectSet, Snapshot
from service.model.domain import Asset
from service.model.errors import DamagedError, NotFoundError
from service.model.records import AttemptRecord, JobEvent, JobRecord
from service.model.states import Stage
from service.store.manifests import ShardManifest
from service.store.packs import DeadShards, pack_at, read_manifests
from service.store.records import parse_record
from service.store.store import Store

#: What the key of a record looks like, and what it must hold.
_RECORDS: Final[tuple[tuple[str, type[Any]], ...]] = (
    (r"assets/[^/]+/[^/]+/asset\.json", Asset),
    (r"jobs/[^/]+/job\.json", JobRecord),
    (r"jobs/[^/]+/events/[^/]+\.json", JobEvent),
    (r"tasks/[^/]+/attempts/[^/]+\.json", AttemptRecord),
    (r"datasets/[^/]+/dataset\.json", DatasetRecord),
    (r"datasets/[^/]+/events/[^/]+\.json", DatasetEvent),
    (r"datasets/[^/]+/snapshots/[^/]+\.json", Snapshot),
    (r"object_sets/[^/]+/[^/]+\.json", ObjectSet),
    (r"packs/[0-9a-f]{32}/[0-9a-f]{32}\.dead/[0-9a-f]{32}\.json", DeadShards),
)
FOLDERS: Final = (
    names.SHARDS, names.ASSETS, names.JOBS, names.TASKS, names.DATASETS, names.OBJECT_SETS, names.PACKS
)  # fmt: skip
_SHARD: Final = re.compile(r"shards/(base|scene|views)/([0-9a-f]{32})\.(h5|json)")
_PACK: Final = re.compile(r"packs/[0-9a-f]{32}/[0-9a-f]{32}\.pack")
STAGES: Final[dict[str, Stage]] = {kind: stage for stage, kind in names.SHARD_KINDS.items()}

MISSING: Final = "its file is gone"
NO_MANIFEST: Final = "it has no manifest"
BAD_MANIFEST: Final = "its manifest is damaged"
FOREIGN: Final = "nothing that graspd put there"
#: How long a file may be without a manifest [s].
_ON_ITS_WAY_S: Final = 60.0
#: Told after each piece that was read: its bytes.
Read = Callable[[int], None]


def scan(store: Store, *folders: str, read: Read = lambda size: None) -> Iterator[tuple[str, Damage | None]]:
    """Every object that can be checked, of all folders or some, with what is wrong with it, None if nothing is.

    Raises:
        StoreUnavailable: the store does not answer.
    """
    for folder in folders or FOLDERS:
        for entry in store.list(folder):
            if is_checked(entry.key):
                yield entry.key, examine(store, entry.key, read=read)


def is_on_its_way(store: Store, one: Damage) -> bool:
    """Whether a file may only wait for the manifest that its worker puts next."""
    try:
        return one.what == NO_MANIFEST and (age_of(store.stamp(one.key)[1]) or 0.0) < _ON_ITS_WAY_S
    except NotFoundError:
        return True


def is_checked(key: str) -> bool:
    """Whether `examine` knows what an object of this name must hold."""
    return key.startswith((f"{names.SHARDS}/", f"{names.PACKS}/")) or _model_of(key) is not None


def examine(store: Store, key: str, *, read: Read = lambda size: None) -> Damage | None:
    """What is wrong with one object; of a shard, its file is examined with its manifest."""
    try:
        if (model := _model_of(key)) is not None:
            return _record(store, key, model)
        if _PACK.fullmatch(key):
            return _pack(store, key, read)
        if (match := _SHARD.fullmatch(key)) is None:
            return Damage(key, FOREIGN) if store.exists(key) else None
        kind, shard, ending = match.groups()
        if ending == "json":
            return _manifest(store, key, STAGES[kind], shard, read)
        manifest = names.shard_manifest(STAGES[kind], shard)
        # A worker puts the manifest last; it may have come since the file was listed.
        orphan = not store.exists(manifest) and store.exists(key) and not store.exists(manifest)
        return Damage(key, NO_MANIFEST, shard) if orphan else None
    except NotFoundError:
        return None  # removed since it was listed


def _model_of(key: str) -> type[Any] | None:
    """What the record of this name must hold; None for what is no record."""
    return next((model for pattern, model in _RECORDS if re.fullmatch(pattern, key)), None)


def _pack(store: Store, key: str, read: Read) -> Damage | None:
    """Directory, manifests and files of those shards of a pack that are there."""
    try:
        pack = pack_at(store, key, anew=True)
    except DamagedError as error:
        return Damage(key, str(error))
    harmed = []
    for shard, made in zip(pack.living, read_manifests(store, pack), strict=True):
        digest = hashlib.sha256()
        for chunk in store.stream(pack.place(shard)):
            digest.update(chunk)
            read(len(chunk))
        if isinstance(made, DamagedError) or digest.hexdigest() != shard.sha256:
            harmed.append(shard.id)
    return Damage(key, f"{len(harmed)} of its {len(pack.shards)} shards: {', '.join(harmed)}") if harmed else None


def _record(store: Store, key: str, model: type[Any]) -> Damage | None:
    try:
        parse_record(model, store.get(key), key)
    except (DamagedError, ValidationError) as error:
        return Damage(key, str(error))
    return None


def _manifest(store: Store, key: str, stage: Stage, shard: str, read: Read) -> Damage | None:
    try:
        manifest = parse_record(ShardManifest, store.get(key), key)
    except DamagedError:
        return Damage(key, BAD_MANIFEST, shard)
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
