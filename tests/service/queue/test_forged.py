"""Whoever writes to Redis can forge entries: the controller goes on feeding and reaping, and pages go on showing."""

from __future__ import annotations

import contextlib
import json
import zlib
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from graspd.api.metrics import Metrics, Snapshot
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import UnavailableError
from graspd.service.model.states import Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller
from graspd.service.pipeline.leading import PART
from graspd.service.queue.port import Event, EventKind
from graspd.service.queue.rq_queue import EVENTS, METRICS, WORKERS, RqQueue, worker_key
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from tests.fakes import add_assets, beat_of, request
from tests.indexes import empty_index

WIP = "rq:wip:interactive-synthesize"
WAITING = "rq:queue:interactive-synthesize"
BEAT = asdict(beat_of(pid=2**70))
EVENT = {"kind": EventKind.FINISHED.value, "at": timestamp(), "stage": "synthesize", "task_id": "t"}


def _message(**facts: object) -> bytes:
    told = {"schema": 1, "stage": "synthesize", **facts}
    return zlib.compress(json.dumps(["graspd.task", None, [told], {}]).encode())


def _beat(redis: Any, name: bytes, **facts: object) -> None:
    redis.sadd(WORKERS, name)
    redis.set(b"graspd:worker:" + name, json.dumps({**BEAT, **facts}))


def _event(redis: Any, **facts: object) -> None:
    redis.xadd(EVENTS, {"e": json.dumps({**EVENT, **facts})})


FORGERIES: dict[str, Callable[[Any], object]] = {
    "a worker whose name is no text": lambda redis: redis.sadd(WORKERS, b"\xff"),
    "a worker with a huge number": lambda redis: _beat(redis, b"w"),
    "a worker with half a letter": lambda redis: _beat(redis, b"w", pid=1, device="\ud800"),
    "a worker whose time is a book": lambda redis: _beat(redis, b"w", pid=1, seen="9" * 5000),
    "a list at a worker's key": lambda redis: (redis.sadd(WORKERS, "l"), redis.rpush(worker_key("l"), "x")),
    "a lease with blanks": lambda redis: redis.zadd(WIP, {"x y z": 1}),
    "a lease that is no text": lambda redis: redis.zadd(WIP, {b"\xff\xfe:\xfd": 1}),
    "a lease with an attempt of 5,000 digits": lambda redis: redis.zadd(WIP, {"a-" + "9" * 5000: 1}),
    "a string at a leased job's key": lambda redis: (redis.zadd(WIP, {"X:1": 1}), redis.set("rq:job:X", "x")),
    "a string at a lease's key": lambda redis: (redis.zadd(WIP, {"X:1": 1}), redis.set("rq:execution:X:1", "x")),
    "a lease of a task that leaves the store": lambda redis: (
        redis.zadd(WIP, {"X:1": 1}),
        redis.hset("rq:job:X", "data", _message(task_id="../x", job_id="", output="../../x")),
    ),
    "a waiting task that is no text": lambda redis: redis.rpush(WAITING, b"\xff"),
    "a waiting task with an attempt of 5,000 digits": lambda redis: redis.rpush(WAITING, "a-" + "9" * 5000),
    "a string at a waiting job's key": lambda redis: (redis.rpush(WAITING, "X"), redis.set("rq:job:X", "x")),
    "an event that names a file's file": lambda redis: _event(redis, output="x.json/y"),
    "an event with a name of 5,000 letters": lambda redis: _event(redis, output="x" * 5000),
    "an event without end": lambda redis: redis.xadd(EVENTS, {"e": b"[" * 100_000}),
    "a stream that is shut": lambda redis: redis.xadd(EVENTS, {"e": "x"}, id=f"{2**64 - 1}-{2**64 - 1}"),
    "a sum that is no number": lambda redis: redis.hset(METRICS, b"\xff", b"much"),
    **{
        f"a string at {name}": lambda redis, name=name: (redis.delete(name), redis.set(name, "x"))  # type: ignore[misc]
        for name in (EVENTS, WORKERS, METRICS, WIP, WAITING)
    },
}


@pytest.fixture
def services(tmp_path: Path, rq_queue: RqQueue) -> Services:
    settings = Settings(data_dir=tmp_path, retry_backoff_s=0.0)
    made = Services(
        settings, open_store(settings.resolved_store_url), empty_index(settings.resolved_index_url), rq_queue
    )
    add_assets(made)
    return made


@pytest.mark.parametrize("what", FORGERIES)
def test_a_forged_entry_stops_nothing(services: Services, what: str) -> None:
    now = [1000.0]
    controller = Controller(services, clock=lambda: now[0])
    queue: Any = services.queue
    controller.round()
    queue.connection.zadd(WIP, {"b" * 32 + "-1:execution": 1})  # of a worker that died
    FORGERIES[what](queue.connection)
    for _ in range(8):
        now[0] += 2.0
        with contextlib.suppress(UnavailableError):  # a round may find a part out of order; it puts that right
            controller.round()
    controller.round()
    job, _ = job_actions.submit(services, request())
    (task,) = services.index.jobs.tasks(job=job.id).items
    assert task.id in queue.waiting(), "feeding goes on"
    assert queue.leases() == [], "what nobody holds is taken off"
    queue.publish(Event(kind=EventKind.STARTED, at=timestamp(), task_id=task.id, stage=Stage.SYNTHESIZE))
    controller.round()
    assert services.index.jobs.get(job.id).state is State.RUNNING, "events are read"
    queue.discard([task.id])
    assert task.id not in queue.waiting()
    page = Snapshot()
    page.add_queue(queue.now(lease_s=6), is_kept=queue.announced(PART))
    page.add_sums(queue.counted())
    assert b"graspd_workers" in Metrics().render(page)
    assert [beat.name for beat in queue.workers()] == []
