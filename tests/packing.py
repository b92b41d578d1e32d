"""Shards in packs: made as joined workers make them."""

from __future__ import annotations

from collections.abc import Sequence

from service.model import names
from service.model.clock import timestamp
from service.model.domain import JobRequest
from service.model.messages import TaskMessage
from service.model.planning import message_of, plan
from service.model.records import JobRecord
from service.model.states import Lane, Stage
from service.pipeline.backends import Parts
from service.queue.port import Event, EventKind
from service.store.manifests import ShardManifest
from service.store.packs import put_pack
from service.store.records import read_record
from service.store.store import Store, open_store
from tests.fakes import make_shard, request


def batches(count: int, **changes: object) -> list[TaskMessage]:
    """The first tasks of a job of so many batches."""
    wanted: JobRequest = request(grasps=32 * count, **changes)
    digests = {"hand_digest": "a" * 32, "object_digest": "b" * 32}
    return tasks_of(JobRecord(id="c" * 32, request=wanted, lane=Lane.BULK, created=timestamp(), **digests))


def tasks_of(job: JobRecord) -> list[TaskMessage]:
    """The messages of a job's first tasks."""
    tasks = [task for task in plan(job) if task.stage is Stage.SYNTHESIZE]
    return [message_of(job, task, attempt=1, max_attempt=3) for task in tasks]


def made_of(message: TaskMessage, *, worker: str = "w") -> tuple[ShardManifest, bytes]:
    """A shard that lies nowhere yet: manifest and file."""
    elsewhere = open_store("memory://")
    manifest = make_shard(elsewhere, message, worker=worker)
    return manifest, elsewhere.get(manifest.key)


def pack(store: Store, messages: Sequence[TaskMessage], *, worker: str = "w") -> str:
    """Do tasks and put what they make as one object; its key."""
    return put_pack(store, [made_of(message, worker=worker) for message in messages])


def packed_job(parts: Parts, job: str, some: slice = slice(None)) -> str:
    """Do the first tasks of a job that was submitted, all or some, as one worker that packs them; the pack's key."""
    record = read_record(JobRecord, parts.store, names.job_record(job))
    key = pack(parts.store, tasks_of(record)[some])
    parts.queue.publish(Event(kind=EventKind.PACKED, at=timestamp(), worker="w", pack=key))
    return key
