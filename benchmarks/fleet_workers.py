"""N simulated workers in one process that send Redis the commands of real workers at the same rates.

usage: python -m benchmarks.fleet_workers WORKERS TASK_S      (settings from the environment)

A worker that holds a task sends heartbeats and progress. After `TASK_S` seconds it writes the manifest of its shard and
reports the end of the task. Manifests are copies of one real manifest under other names. Shards are not written,
because no controller reads them. One process with shared pipelines replaces a thousand interpreters, which do not fit
on the measured machine. The load on Redis is the same."""

from __future__ import annotations

import heapq
import json
import random
import signal
import sys
import time
import uuid
import zlib
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

from rq.defaults import DEFAULT_WORKER_TTL as LEASE_KEPT_S

from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.messages import TaskMessage, capabilities
from graspd.service.model.states import Priority, Stage
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.queue.entries import (
    execution_keys,
    job_key,
    lease_registry_key,
    list_key,
    queue_name,
    rq_worker_key,
)
from graspd.service.queue.port import Event, EventKind
from graspd.service.queue.rq_queue import WORKERS, RqQueue, cancel_key, open_queue, put_event, worker_key
from graspd.service.settings import Settings
from graspd.service.store.store import Store, open_store
from graspd.worker.process.heartbeat import BEAT_S
from tests.fakes import make_shard

_TICK_S: Final = 0.02
_QUEUES: Final = tuple(queue_name(priority, Stage.SYNTHESIZE) for priority in Priority)


@dataclass
class Held:
    worker: str
    message: dict[str, Any]
    queue: str
    entry: str
    begun: float
    ends: float

    @property
    def job_key(self) -> str:
        return job_key(self.entry.partition(":")[0])


class Fleet:
    """Workers that take tasks from Redis and end them after a fixed time."""

    def __init__(self, queue: RqQueue, store: Store, *, workers: int, task_s: float, lease_s: float) -> None:
        self._queue, self._store, self._connection = queue, store, queue.connection
        self._task_s, self._lease_s = task_s, lease_s
        self._beat_s = min(BEAT_S, lease_s / 3)
        self._idle = deque(f"fake-{number:05d}" for number in range(workers))
        self._held: dict[str, Held] = {}
        self._ends: list[tuple[float, str]] = []
        now = time.monotonic()
        self._beats = [(now + random.random() * self._beat_s, name) for name in self._idle]
        heapq.heapify(self._beats)
        self._template = ""
        self._names: tuple[str, ...] = ()
        self._pool = ThreadPoolExecutor(8)
        self._first = True

    def tick(self) -> None:
        now = time.monotonic()
        with self._connection.pipeline(transaction=False) as pipe:
            self._end_due(pipe, now)
            pipe.execute()
            self._take(pipe, now)
            self._beat_due(pipe, now)
            pipe.execute()

    def _end_due(self, pipe: Any, now: float) -> None:
        due = []
        while self._ends and self._ends[0][0] <= now:
            due.append(self._held.pop(heapq.heappop(self._ends)[1]))
        list(self._pool.map(self._publish, (held.message for held in due)))
        for held in due:
            pipe.zrem(lease_registry_key(held.queue), held.entry)
            pipe.delete(*execution_keys(held.entry), held.job_key)
            self._say(pipe, held, EventKind.FINISHED, seconds=self._task_s, output=held.message["output"])
            self._idle.append(held.worker)

    def _take(self, pipe: Any, now: float) -> None:
        for queue in _QUEUES:
            if not self._idle or not (jobs := self._connection.lpop(list_key(queue), len(self._idle))):
                continue
            with self._connection.pipeline(transaction=False) as read:
                for job in jobs:
                    read.hget(job_key(job.decode()), "data")
                found = read.execute()
            for job, data in zip(jobs, found, strict=True):
                if data is not None:
                    self._hold(pipe, job.decode(), json.loads(zlib.decompress(data))[2][0], queue, now)
        self._first = self._first and not self._held

    def _hold(self, pipe: Any, job: str, message: dict[str, Any], queue: str, now: float) -> None:
        # The first tasks end evenly over the time of one task, since workers of a fleet are not synchronous.
        length = self._task_s * (random.random() if self._first else 1.0)
        held = Held(self._idle.popleft(), message, queue, f"{job}:{uuid.uuid4().hex}", now, now + length)
        self._held[held.worker] = held
        heapq.heappush(self._ends, (held.ends, held.worker))
        execution, executions = execution_keys(held.entry)
        pipe.hset(execution, mapping={"id": held.entry, "last_heartbeat": time.time(), "worker_name": held.worker})
        pipe.expire(execution, LEASE_KEPT_S)
        pipe.zadd(executions, {held.entry: time.time() + LEASE_KEPT_S})
        pipe.zadd(lease_registry_key(queue), {held.entry: time.time() + LEASE_KEPT_S})
        pipe.hset(held.job_key, mapping={"status": "started", "worker_name": held.worker})
        self._say(pipe, held, EventKind.STARTED)

    def _beat_due(self, pipe: Any, now: float) -> None:
        while self._beats[0][0] <= now:
            name = heapq.heappop(self._beats)[1]
            heapq.heappush(self._beats, (now + self._beat_s, name))
            held = self._held.get(name)
            pipe.set(worker_key(name), json.dumps(_beat(name, held)), ex=max(2, round(self._lease_s)))
            pipe.sadd(WORKERS, name)
            if held is not None:
                execution, executions = execution_keys(held.entry)
                kept_until = {held.entry: time.time() + LEASE_KEPT_S}
                pipe.zscore(lease_registry_key(held.queue), held.entry)
                pipe.exists(cancel_key(held.message["task_id"]))
                pipe.hset(rq_worker_key(name), "last_heartbeat", timestamp())
                pipe.expire(rq_worker_key(name), LEASE_KEPT_S)
                pipe.hset(execution, "last_heartbeat", time.time())
                pipe.expire(execution, LEASE_KEPT_S)
                pipe.zadd(executions, kept_until)
                pipe.expire(executions, LEASE_KEPT_S)
                for _ in range(2):
                    pipe.zadd(lease_registry_key(held.queue), kept_until, xx=True)

    def _say(self, pipe: Any, held: Held, kind: EventKind, **facts: Any) -> None:
        message = held.message
        event = Event(
            kind=kind,
            at=timestamp(),
            task_id=message["task_id"],
            job_id=message["job_id"],
            stage=message["stage"],
            batch=message["batch"],
            attempt=message["attempt"],
            worker=held.worker,
            **facts,
        )
        put_event(pipe, event)

    def _publish(self, message: dict[str, Any]) -> None:
        self._store.put(names.shard_manifest_key(Stage.SYNTHESIZE, message["output"]), self._manifest(message).encode())

    def _manifest(self, message: dict[str, Any]) -> str:
        if not self._template:
            task, elsewhere = TaskMessage.model_validate(message), open_store("memory://")
            manifest = make_shard(elsewhere, task)
            self._names = (task.output, f'"batch":{task.batch},', f'"seed":{task.request.seed},')
            self._template = manifest.model_dump_json()
        output, batch, seed = self._names
        text = self._template.replace(output, message["output"]).replace(batch, f'"batch":{message["batch"]},')
        return text.replace(seed, f'"seed":{message["request"]["seed"]},')


def _beat(name: str, held: Held | None) -> dict[str, Any]:
    now = timestamp()
    task = held.message["task_id"] if held else ""
    return {
        "name": name,
        "host": "fleet",
        "pid": 1,
        "device": "cpu",
        "device_name": "none",
        "stages": ["synthesize"],
        "version": PACKAGE_VERSION,
        "state": "busy" if held else "idle",
        "task_id": task,
        "started": now,
        "seen": now,
        "schemas": capabilities().schemas,
        "revisions": dict(capabilities().revisions),
        "done": time.monotonic() - held.begun if held else 0.0,
        "message": "pretending" if held else "",
    }


def main() -> None:
    workers, task_s = int(sys.argv[1]), float(sys.argv[2])
    settings = Settings()
    fleet = Fleet(
        open_queue(settings),
        open_store(settings.resolved_store_url),
        workers=workers,
        task_s=task_s,
        lease_s=settings.lease_s,
    )
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: ended.append(number))
    while not ended:
        begun = time.monotonic()
        fleet.tick()
        time.sleep(max(0.0, _TICK_S - (time.monotonic() - begun)))


if __name__ == "__main__":
    main()
