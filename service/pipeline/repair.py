"""Repair of a store: damaged shards are made again, since a shard is a function of its inputs."""

from __future__ import annotations

import contextlib
import hashlib
import re
from collections.abc import Sequence
from typing import Final

from graspd.service.index.notes import Damage
from graspd.service.model import names
from graspd.service.model.errors import DamagedError, NotFoundError
from graspd.service.model.planning import PlannedTask, message_of, plan
from graspd.service.model.records import JobRecord
from graspd.service.model.states import AssetKind, Priority, Stage
from graspd.service.model.version import STAGE_REVISIONS
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.integrity import BAD_MANIFEST, FOREIGN, MISSING, NO_MANIFEST, STAGES, may_await_manifest
from graspd.service.store.library import builtin_assets, load_asset, publish_builtins
from graspd.service.store.records import read_record, task_attempts

_OF_ASSET: Final = re.compile(r"assets/(hand|object|network)/([0-9a-f]{32})/(.+)")


def repair(services: Services, found: Sequence[Damage]) -> tuple[list[Damage], list[Damage]]:
    """Move damaged objects below `damaged/`, and queue what can be made again; return repaired objects, and the rest.

    A worker stores a repaired shard only if its checksum equals the manifest's.
    """
    harmed = {one.shard for one in found if one.shard}
    repaired, left = [], []
    for one in found:
        if why := _fix(services, one, harmed):
            left.append(Damage(one.key, f"{one.what}; {why}", one.shard))
        else:
            repaired.append(one)
    return repaired, left


def _fix(services: Services, one: Damage, harmed: set[str]) -> str:
    """Repair one object; return the reason if this is impossible, else ""."""
    if one.what == FOREIGN:
        services.store.set_aside(one.key)
        return ""
    if match := _OF_ASSET.fullmatch(one.key):
        return _asset(services, one.key, AssetKind(match[1]), match[2], match[3])
    if not one.shard:
        return "put a copy in its place"
    stage = STAGES[one.key.split("/")[1]]
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
        _clear(services, one, stage)
    number = len(task_attempts(services.store, task.id)) + 1
    message = message_of(job, task, attempt=number, max_attempt=number)
    services.queue.enqueue([message], Priority.BULK, again=True)
    return ""


def _asset(services: Services, key: str, kind: AssetKind, digest: str, file: str) -> str:
    """Move derived files of a hand or an object away; a new check and the next task make them again.

    Built-in assets are stored again from the program.
    """
    if (kind, digest) in {(one.kind, one.digest) for one in builtin_assets()}:
        services.store.set_aside(key)
        publish_builtins(services.store)
    elif file == "files.zip":
        return "upload the same files again, or put a copy in its place"
    elif file == "asset.json":
        return "put a copy in its place"
    else:
        services.store.set_aside(key)
    if file in ("model.glb", "check.json") and not services.store.exists(key):
        services.store.set_aside(names.asset_check(kind, digest))
        with contextlib.suppress(NotFoundError, DamagedError):
            services.index.write.add_asset(load_asset(services.store, kind, digest), None)
            services.index.live.set_asset_waiting([digest], queued=False)
    return ""


def _clear(services: Services, one: Damage, stage: Stage) -> None:
    """Move a damaged result away; a file without manifest stays if the index contains its checksum."""
    file, manifest = names.shard_file(stage, one.shard), names.shard_manifest(stage, one.shard)
    if one.what == BAD_MANIFEST:
        services.store.set_aside(manifest)
    if one.what not in (BAD_MANIFEST, NO_MANIFEST) or not _matches_index(services, one.shard, file):
        services.store.set_aside(file)


def _matches_index(services: Services, shard: str, file: str) -> bool:
    try:
        return services.index.shards.get(shard).sha256 == hashlib.sha256(services.store.get(file)).hexdigest()
    except NotFoundError:
        return False


def _task_of_shard(services: Services, stage: Stage, shard: str) -> tuple[JobRecord, PlannedTask] | str:
    """Return the task that makes a shard, or the reason why there is none."""
    job = services.index.shards.job_of(shard)
    if job is None:
        return "no job makes it, so it cannot be made again; put a copy in its place"
    try:
        record = read_record(JobRecord, services.store, names.job_record(job))
    except (NotFoundError, DamagedError) as error:
        return f"the job that makes it cannot be read: {error}"
    if (made := record.revisions.get(stage)) != STAGE_REVISIONS[stage]:
        return f"it is of revision {made} of {stage}, and this graspd makes revision {STAGE_REVISIONS[stage]}"
    task = next((task for task in plan(record) if task.output == shard), None)
    return (record, task) if task is not None else "its job does not make it"
