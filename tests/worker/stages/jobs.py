"""Jobs of a Barrett hand and a block, run as a worker runs them."""

from __future__ import annotations

from typing import Any

from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import job_id
from graspd.service.model.domain import JobRequest
from graspd.service.model.planning import message_of, plan
from graspd.service.model.records import JobRecord
from graspd.service.model.states import AssetKind, Priority, Stage
from graspd.service.queue.port import Event, EventKind
from graspd.service.store.assets import builtin_files
from graspd.service.store.library import publish_asset
from graspd.service.store.records import put_record
from graspd.service.store.store import Store
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.process.runner import Runner
from graspd.worker.stages import render, scene, synthesize
from graspd.worker.stages.context import TaskContext

STAGES = {Stage.SCENE: scene.run, Stage.SYNTHESIZE: synthesize.run, Stage.RENDER: render.run}


def job_of(store: Store, span: int = 1, **request: Any) -> JobRecord:
    """A job of the built-in hand and object, in the store with them."""
    hand = publish_asset(store, AssetKind.HAND, "barrett", builtin_files(AssetKind.HAND, "barrett"))
    obj = publish_asset(store, AssetKind.OBJECT, "block", builtin_files(AssetKind.OBJECT, "block"))
    wanted = JobRequest(hand="barrett", object="block", **request)
    job = JobRecord(
        id=job_id(wanted, hand.digest, obj.digest),
        request=wanted,
        hand_digest=hand.digest,
        object_digest=obj.digest,
        priority=Priority.BULK,
        span=span,
        created=timestamp(),
    )
    put_record(store, names.job_record(job.id), job)
    return job


def end_of(store: Store, job: JobRecord) -> Event:
    """The end of the last of a job's tasks, or of the first one that fails."""
    runner = Runner(STAGES, worker="w", publish=lambda event: None)
    for task in plan(job):
        message = message_of(job, task, attempt=1, max_attempt=3).model_dump(mode="json", by_alias=True)
        event = runner.run(message, TaskContext(store, ExecutionContext(threads=2)))
        if event.kind is not EventKind.FINISHED:
            break
    return event
