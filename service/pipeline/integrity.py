"""Integrity of a store: check of stored objects, repeated scan by the controller, repair.

The check changes nothing. The scan has a limited rate and can resume. A repair makes damaged shards again.
"""

import contextlib
import hashlib
import heapq
import logging
import re
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

from graspd.service.index.notes import Damage, ScanNote
from graspd.service.model import names, records
from graspd.service.model.clock import age_of, timestamp
from graspd.service.model.digests import digest_files
from graspd.service.model.domain import Asset
from graspd.service.model.errors import DamagedError, GraspdError, InputError, NotFoundError
from graspd.service.model.planning import PlannedTask, create_task_message, plan_tasks
from graspd.service.model.states import AssetKind, Priority, Stage
from graspd.service.model.version import STAGE_REVISIONS
from graspd.service.model.webhooks import Webhook
from graspd.service.pipeline.backends import Services
from graspd.service.store.assets import ZipFiles
from graspd.service.store.integrity import is_sealed
from graspd.service.store.library import UNPACKED_LIMIT_BYTES, builtin_assets, load_asset, load_check, publish_builtins
from graspd.service.store.manifests import ShardManifest
from graspd.service.store.records import (
    CHARTS,
    IN_SCENES,
    STABILITY,
    DeletedJob,
    Deletion,
    parse_record,
    read_record,
    task_attempts,
)
from graspd.service.store.store import Store

log = logging.getLogger(__name__)
#: Minimum interval between the starts of two rounds [s].
ROUND_S: Final = 3600.0
#: Interval [s] at which known damage is checked again.
_AGAIN_S: Final = 60.0
_KNOWN: Final = 1000
#: Maximum number of keys in memory; more keys need another listing of the folder.
_KEYS: Final = 10_000
#: Size [bytes] that is added for each stored object, to limit the rate of small ones.
_LEAST: Final = 16 * 2**10
#: Maximum delay [s] that faster reads may make up for.
_BURST_S: Final = 0.25
#: Interval [s] of queries whether the scan is paused by `graspd admin store verify`.
_PAUSE_S: Final = 5.0
_OF_ASSET: Final = re.compile(r"assets/(hand|object|network)/([0-9a-f]{32})/(.+)")
#: Key patterns of records, and the model of each.
_RECORDS: Final[tuple[tuple[str, type[Any]], ...]] = (
    (r"assets/[^/]+/[^/]+/asset\.json", Asset),
    (r"jobs/[^/]+/job\.json", records.JobRecord),
    (r"jobs/[^/]+/events/[^/]+\.json", records.JobEvent),
    (r"tasks/[^/]+/attempts/[^/]+\.json", records.AttemptRecord),
    (r"datasets/[^/]+/dataset\.json", records.DatasetRecord),
    (r"datasets/[^/]+/events/[^/]+\.json", records.DatasetEvent),
    (r"datasets/[^/]+/snapshots/[^/]+\.json", records.Snapshot),
    (r"object_sets/[^/]+/[^/]+\.json", records.ObjectSet),
    (r"deletions/[^/]+/[^/]+\.json", Deletion),
    (r"released/[^/]+\.json", DeletedJob),
    (r"webhooks/[^/]+\.json", Webhook),
    (r"tags/[^/]+/[^/]+\.json", records.Tag),
)
#: Folders in the order of a scan, which stores its position.
FOLDERS: Final = (
    *(names.SHARDS, names.ASSETS, names.JOBS, names.TASKS, names.DATASETS, names.OBJECT_SETS, names.DELETIONS),
    *(names.RELEASED, names.WEBHOOKS, names.TAGS, CHARTS, IN_SCENES, STABILITY),
    *(names.MARKS, names.SERVICE, names.REMOVED),
)
_SEALED: Final = (".json", ".zip", ".npz", ".glb")
_SHARD: Final = re.compile(rf"shards/({'|'.join(names.STAGES)})/([0-9a-f]{{32}})\.(h5|json)")
MISSING: Final = "its file is missing"
NO_MANIFEST: Final = "it has no manifest"
BAD_MANIFEST: Final = "its manifest is damaged"
FOREIGN: Final = "graspd did not write it"
#: Time [s] for which a new file may lack its manifest.
_ON_ITS_WAY_S: Final = 60.0
Read = Callable[[int], object]
#: Called with the key of each stored object that has no checksum.
Unsealed = Callable[[str], None]


def scan(
    store: Store, *folders: str, read: Read = lambda size: None, unsealed: Unsealed = lambda key: None
) -> Iterator[tuple[str, Damage | None]]:
    """Yield the key of each checked object in all or some folders, with its damage or None."""
    for folder in folders or FOLDERS:
        for entry in store.list(folder):
            if is_checked(entry.key):
                yield entry.key, examine(store, entry.key, read=read, unsealed=unsealed)


def may_await_manifest(store: Store, one: Damage) -> bool:
    """Return whether a file without manifest is so recent that its worker may still write the manifest."""
    try:
        return one.what == NO_MANIFEST and (age_of(store.stamp(one.key)[1]) or 0.0) < _ON_ITS_WAY_S
    except NotFoundError:
        return True


def is_checked(key: str) -> bool:
    return key.startswith(f"{names.SHARDS}/") or key.endswith(_SEALED)


def examine(
    store: Store, key: str, *, read: Read = lambda size: None, unsealed: Unsealed = lambda key: None
) -> Damage | None:
    """Return the damage of a stored object or None; the file of a shard is checked with its manifest."""
    try:
        if not key.startswith(f"{names.SHARDS}/"):
            return _check_sealed(store, key, read, unsealed)
        if (match := _SHARD.fullmatch(key)) is None:
            return Damage(key, FOREIGN) if store.exists(key) else None
        kind, shard, ending = match.groups()
        if ending == "json":
            return _check_manifest(store, key, names.STAGES[kind], shard, read, unsealed)
        manifest = names.shard_manifest_key(names.STAGES[kind], shard)
        # The manifest is written last, possibly between these calls.
        orphan = not store.exists(manifest) and store.exists(key) and not store.exists(manifest)
        return Damage(key, NO_MANIFEST, shard) if orphan else None
    except NotFoundError:
        return None  # The object was removed after the listing.


def _check_sealed(store: Store, key: str, read: Read, unsealed: Unsealed) -> Damage | None:
    """Check a stored object by the checksum that it contains; parse records and checks of assets."""
    match = _OF_ASSET.fullmatch(key)
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


def _check_manifest(store: Store, key: str, stage: Stage, shard: str, read: Read, unsealed: Unsealed) -> Damage | None:
    try:
        data = store.get(key)
        manifest = parse_record(ShardManifest, data, key)
    except DamagedError:
        return Damage(key, BAD_MANIFEST, shard)
    if not is_sealed(key, [data], len(data)):
        unsealed(key)
    file = names.shard_file_key(stage, shard)
    if (manifest.shard_id, manifest.key) != (shard, file):
        return Damage(key, BAD_MANIFEST, shard)
    try:
        if (size := store.size(file)) != manifest.size_bytes:
            return Damage(file, f"it has {size} bytes, expected {manifest.size_bytes}", shard)
        digest = hashlib.sha256()
        for chunk in _count_bytes(store.stream(file), read):
            digest.update(chunk)
    except NotFoundError:
        return Damage(file, MISSING, shard) if store.exists(key) else None
    if digest.hexdigest() != manifest.sha256:
        return Damage(file, f"its SHA-256 is {digest.hexdigest()[:12]}..., expected {manifest.sha256[:12]}...", shard)
    return None


class ScanInterrupted(Exception):
    """The process stops, or `graspd admin store verify` pauses the scan."""


class IntegrityScan:
    """Checks all stored objects in rounds, and updates the list of damage in the index."""

    def __init__(
        self, services: Services, stop: threading.Event, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._services, self._stop, self._clock = services, stop, clock
        self._rate = services.settings.integrity_scan_mb_per_s * 2**20
        self._asked = -_PAUSE_S
        self._paid = clock()
        self._looked = clock()

    def run(self) -> None:
        """Run until `stop` is set; wait for an unavailable backend."""
        while not self._stop.is_set():
            try:
                if self._may_read() and self.advance():
                    continue
            except ScanInterrupted:
                pass
            except GraspdError as error:
                log.warning("%s; the integrity scan continues later", error)
            except Exception:
                log.exception("the integrity scan failed and will continue later")
            self._stop.wait(_PAUSE_S)

    def _may_read(self) -> bool:
        """Return whether the scan is not paused; the index is queried every `_PAUSE_S`."""
        now = self._clock()
        if now - self._asked >= _PAUSE_S:
            if self._services.index.notes.is_scan_paused():
                return False
            self._asked = now
        return True

    def advance(self) -> bool:
        """Check the next `_KEYS` keys; return False if no round is due; Interrupted as in the class."""
        self._recheck_if_due(None)
        note = self._services.index.notes.scan_note()
        if note.folder >= len(FOLDERS):
            if (age_of(note.started) or 0.0) < ROUND_S:
                return False
            note = ScanNote()
        note = note if note.started else replace(note, started=timestamp())
        keys = self._next_keys(FOLDERS[note.folder], note.after)
        for key in keys:
            if is_checked(key):
                self._limit_rate(_LEAST)
                wrong = examine(self._services.store, key, read=self._limit_rate)
                if wrong is not None and not may_await_manifest(self._services.store, wrong):
                    log.warning("%s: %s", wrong.key, wrong.what)
                    self._services.index.damage.update([wrong])
            self._recheck_if_due(replace(note, after=key))
        over = len(keys) < _KEYS
        note = replace(note, folder=note.folder + over, after="" if over else keys[-1])
        if note.folder == len(FOLDERS):
            note = replace(note, ended=timestamp())
        self._services.index.notes.set_scan_note(note)
        return True

    def _recheck_if_due(self, reached: ScanNote | None) -> None:
        if self._clock() - self._looked > _AGAIN_S:
            if reached is not None:
                self._services.index.notes.set_scan_note(reached)
            self.recheck_damage()

    def recheck_damage(self) -> None:
        """Check known damage again; remove repaired and deleted objects from the list."""
        self._looked = self._clock()
        _, known = self._services.index.damage.summary(limit=_KNOWN)
        if well := [one.key for one in known if self._is_repaired(one)]:
            self._services.index.damage.update([], intact=well)

    def _is_repaired(self, one: Damage) -> bool:
        stem, dot, _ = one.key.rpartition(".")
        keys = [f"{stem}.json", f"{stem}.h5"] if one.shard and dot else [one.key]
        return all(examine(self._services.store, key, read=self._limit_rate) is None for key in keys)

    def _next_keys(self, folder: str, after: str) -> list[str]:
        listed = self._services.store.list(folder, offset=after or None)
        return heapq.nsmallest(_KEYS, (entry.key for entry in listed))

    def _limit_rate(self, size: int) -> None:
        """Wait until `size` more bytes are within the rate; Interrupted if the scan must end."""
        now = self._clock()
        self._paid = max(self._paid, now - _BURST_S) + size / self._rate
        if self._stop.wait(max(0.0, self._paid - now)) or not self._may_read():
            raise ScanInterrupted


def repair(services: Services, found: Sequence[Damage]) -> tuple[list[Damage], list[Damage]]:
    """Move damaged files to `damaged/`, queue tasks to make them again; return repaired and other damage."""
    harmed = {one.shard for one in found if one.shard}
    repaired, left = [], []
    for one in found:
        if why := _repair_object(services, one, harmed):
            left.append(Damage(one.key, f"{one.what}; {why}", one.shard))
        else:
            repaired.append(one)
    return repaired, left


def _repair_object(services: Services, one: Damage, harmed: set[str]) -> str:
    """Repair a stored object; return why this is impossible, or ""."""
    if one.what == FOREIGN:
        services.store.set_aside(one.key)
        return ""
    if match := _OF_ASSET.fullmatch(one.key):
        return _repair_asset(services, one.key, AssetKind(match[1]), match[2], match[3])
    if not one.shard:
        return "put a copy in its place"
    stage = names.STAGES[one.key.split("/")[1]]
    if may_await_manifest(services.store, one):
        return "its manifest may follow soon; run the command again in a minute"
    planned = _task_of_shard(services, stage, one.shard)
    if isinstance(planned, str):
        if one.what == NO_MANIFEST:
            services.store.set_aside(one.key)
            return ""
        return planned
    job, task = planned
    if harmed & set(task.inputs):
        return "its input is made again first; run the command again when that is done"
    if one.what != MISSING:
        file, manifest = names.shard_file_key(stage, one.shard), names.shard_manifest_key(stage, one.shard)
        if one.what == BAD_MANIFEST:
            services.store.set_aside(manifest)
        if one.what not in (BAD_MANIFEST, NO_MANIFEST) or not _matches_index(services, one.shard, file):
            services.store.set_aside(file)
    number = len(task_attempts(services.store, task.id)) + 1
    message = create_task_message(job, task, attempt=number, max_attempt=number)
    services.queue.enqueue([message], Priority.BULK, again=True)
    return ""


def _repair_asset(services: Services, key: str, kind: AssetKind, digest: str, file: str) -> str:
    """Move files of an asset away that a check or the next task makes again; store built-in assets again."""
    is_builtin = (kind, digest) in {(one.kind, one.digest) for one in builtin_assets()}
    if file == "files.zip" and not is_builtin:
        return "upload the same files again, or put a copy in its place"
    if file == "asset.json" and not is_builtin:
        return "put a copy in its place"
    services.store.set_aside(key)
    if is_builtin:
        publish_builtins(services.store)
    if file in ("model.glb", "check.json") and not services.store.exists(key):
        services.store.set_aside(names.asset_key(kind, digest, "check.json"))
        with contextlib.suppress(NotFoundError, DamagedError):
            services.index.write.add_asset(load_asset(services.store, kind, digest), None)
            services.index.live.set_asset_waiting([digest], queued=False)
    return ""


def _matches_index(services: Services, shard: str, file: str) -> bool:
    try:
        return services.index.shards.get(shard).sha256 == hashlib.sha256(services.store.get(file)).hexdigest()
    except NotFoundError:
        return False


def _task_of_shard(services: Services, stage: Stage, shard: str) -> tuple[records.JobRecord, PlannedTask] | str:
    """Return job and task that make a shard, or why no task can make it."""
    job = services.index.shards.job_of(shard)
    if job is None:
        return "no job makes it, so it cannot be made again; put a copy in its place"
    try:
        record = read_record(records.JobRecord, services.store, names.job_record_key(job))
    except (NotFoundError, DamagedError) as error:
        return f"the job that makes it cannot be read: {error}"
    if (made := record.revisions.get(stage)) != STAGE_REVISIONS[stage]:
        return f"it is of revision {made} of {stage}, and this graspd makes revision {STAGE_REVISIONS[stage]}"
    task = next((task for task in plan_tasks(record) if task.output == shard), None)
    return (record, task) if task is not None else "its job does not make it"
