"""The queue on Redis: RQ for tasks and leases, a bounded stream for events.

One RQ queue a lane and stage, so that a worker may serve some stages only. RQ's own retries, scheduler, maintenance and
result storage are not used: each of them loses or repeats work in ways the controller does not.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final

from redis import Redis
from redis.exceptions import LockError, RedisError, ResponseError
from rq import Queue
from rq.exceptions import DuplicateJobError
from rq.executions import Execution
from rq.job import Job
from rq.serializers import JSONSerializer

from service.model.errors import QueueUnavailable
from service.model.states import Lane, Stage
from service.model.workers import WorkerBeat, need_of
from service.queue import entries, rq_keys
from service.queue.address import redis_url
from service.queue.allowed import TASK_FUNCTION, new_job
from service.queue.at_scrape import read_queue
from service.queue.connection import connect
from service.queue.lists import known_lists, place_of, queue_name, without_takers
from service.queue.port import Event, Holder, Lease, Message, QueueNow, Report
from service.queue.reports import REPORTS, drop_reports, put_report, read_reports
from service.queue.rq_keys import LISTS, execution_keys, held_key, job_key, list_key
from service.queue.streams import EVENTS, EventReader, put_event, readable
from service.settings import Settings

WORKERS: Final = "graspd:workers"
#: Lease of the controller that leads. A graspd of 0.2 takes and keeps the same one: so the two give way to each other.
LEAD: Final = "graspd:lead:keeper"
#: Sums for Prometheus, a few hundred fields.
METRICS: Final = "graspd:metrics"
_SERVICE: Final = "graspd:service"
_CANCEL_TTL_S: Final = 24 * 3600
_WORKER: Final = b"graspd:worker:"


class RqQueue:
    """`TaskQueue` on Redis."""

    def __init__(self, connection: Redis) -> None:
        self.connection: Any = connection
        self._queues: dict[str, Queue] = {}
        self._reader = EventReader(connection)
        self._leases: dict[str, Any] = {}
        """Locks of those who lead, or want to, through this connection."""

    def ping(self) -> float:
        start = time.perf_counter()
        with _mapped():
            self.connection.ping()
        return time.perf_counter() - start

    def enqueue(self, messages: Sequence[Message], lane: Lane, *, again: bool = False, apart: bool = False) -> int:
        stale = [cancel_key(message.task_id) for message in messages]
        if again:
            stale += [job_key(rq_id(message.task_id, message.attempt)) for message in messages]
        added = 0
        with _mapped():
            if stale:
                self.connection.delete(*stale)
            for message in messages:
                name = queue_name(lane, message.stage, need_of(message) if apart else None)
                if name not in self._queues:
                    self._queues[name] = Queue(name, self.connection, serializer=JSONSerializer)
                with suppress(DuplicateJobError):
                    self._queues[name].enqueue_job(self._job(message), unique=True)
                    added += 1
        return added

    def discard(self, task_ids: Collection[str]) -> None:
        wanted = set(task_ids)
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            for task in wanted:
                pipe.set(cancel_key(task), "1", ex=_CANCEL_TTL_S)
            pipe.execute()
            for key in self._list_keys():
                for job in self.connection.lrange(key, 0, -1):
                    if entries.task_of(entries.text(job))[0] in wanted:
                        pipe.lrem(key, 0, job)
                        pipe.delete(job_key(entries.text(job)))
            pipe.execute()

    def waiting(self) -> set[str]:
        with _mapped(), self.connection.pipeline(transaction=True) as pipe:
            for key in self._list_keys():
                pipe.lrange(key, 0, -1)
            return {entries.task_of(entries.text(job))[0] for jobs in pipe.execute() for job in jobs}

    def depths(self) -> dict[tuple[Lane, Stage], int]:
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            lists = known_lists(self.connection)
            for name in lists:
                pipe.llen(list_key(name))
            depths: Counter[tuple[Lane, Stage]] = Counter()
            for name, length in zip(lists, pipe.execute(), strict=True):
                depths[place_of(name)] += length
            return dict(depths)

    def clear_untaken(self, present: Collection[WorkerBeat]) -> None:
        abilities = [(stage, beat.ability) for beat in present for stage in beat.stages]
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            for name in without_takers(known_lists(self.connection), abilities):
                key = list_key(name)
                for job in self.connection.lrange(key, 0, -1):
                    pipe.delete(job_key(entries.text(job)))
                pipe.delete(key)
                # Where one of them is still held, its lease is read under the list's name.
                if not self.connection.exists(held_key(name)):
                    pipe.srem(LISTS, key)
            pipe.execute()

    def leases(self) -> list[Lease]:
        # RQ's own readers clean up as they read, which moves lost tasks aside and runs callbacks; so the keys are read.
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            keys = [held_key(name) for name in known_lists(self.connection)]
            for key in keys:
                pipe.zrange(key, 0, -1, withscores=True)
            found = pipe.execute()
        return [_lease(key, entry, score) for key, held in zip(keys, found, strict=True) for entry, score in held]

    def holder(self, lease: Lease) -> Holder:
        job = entries.text(bytes.fromhex(lease.key.partition(" ")[2]).partition(b":")[0])
        with _mapped():
            worker, data = entries.fields(self.connection, job_key(job), "worker_name", "data")
        return Holder(entries.text(worker), entries.message(data))

    def release(self, lease: Lease) -> None:
        key, _, digits = lease.key.partition(" ")
        entry = bytes.fromhex(digits)
        name = entries.text(entry)
        with _mapped(), self.connection.pipeline(transaction=True) as pipe:
            pipe.zrem(key, entry)
            pipe.delete(*execution_keys(name), job_key(name.partition(":")[0]))
            pipe.hdel(REPORTS, lease.task_id)
            pipe.execute()

    def workers(self) -> list[WorkerBeat]:
        with _mapped():
            names = sorted(self.connection.smembers(WORKERS))
            found = self.connection.mget([_WORKER + name for name in names]) if names else []
        return [beat for beat in map(entries.beat, found) if beat is not None]

    def publish(self, *events: Event) -> None:
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            for event in events:
                put_event(pipe, event)
                if event.kind.ends_attempt:
                    pipe.hdel(REPORTS, event.task_id)
            pipe.execute()

    def report(self, task_id: str, report: Report) -> float:
        with _mapped():
            return put_report(self.connection, task_id, report, WORKERS)

    def reports(self) -> dict[str, Report]:
        with _mapped():
            return read_reports(self.connection)

    def forget_reports(self, task_ids: Collection[str]) -> None:
        with _mapped():
            drop_reports(self.connection, task_ids)

    def consume(self, *, limit: int, wait_s: float) -> list[tuple[str, Event]]:
        with _mapped():
            return self._reader.read(limit=limit, wait_s=wait_s)

    def acknowledge(self, event_ids: Sequence[str]) -> None:
        if event_ids:
            with _mapped():
                self._reader.acknowledge(event_ids)

    def tail(self, after: str, *, limit: int, wait_s: float) -> list[tuple[str, Event]]:
        with _mapped():
            block = max(1, int(wait_s * 1000)) if wait_s > 0 else None
            return readable(self.connection.xread({EVENTS: after}, count=limit, block=block))

    def announce(self, part: str, seconds: float) -> None:
        with _mapped():
            self.connection.set(_part_key(part), "1", px=int(seconds * 1000))

    def announced(self, part: str) -> bool:
        with _mapped():
            return bool(self.connection.exists(_part_key(part)))

    def service(self) -> str | None:
        with _mapped():
            found = self.connection.get(_SERVICE)
        return None if found is None else entries.text(found)

    def set_service(self, identity: str, *, instead: bool = False) -> None:
        with _mapped():
            self.connection.set(_SERVICE, identity, nx=not instead)

    def lead(self, holder: str, seconds: float) -> bool:
        with _mapped():
            new = self.connection.lock(LEAD, timeout=seconds, thread_local=False)
            lease = self._leases.setdefault(holder, new)
            lease.timeout = seconds
            try:
                if lease.owned():
                    return bool(lease.reacquire())
                self.resign(holder)  # what a process of the same name left when it ended
                if lease.acquire(blocking=False, token=holder):
                    return True
                if self.connection.ttl(LEAD) == -1:  # nobody's: a lease has an end
                    self.connection.delete(LEAD)
            except LockError:
                pass
            except ResponseError as error:
                if not entries.is_wrong_type(error):
                    raise
                self.connection.delete(LEAD)
            return False

    def resign(self, holder: str) -> None:
        with _mapped(), suppress(LockError):
            self.connection.lock(LEAD).do_release(holder)

    def now(self, *, lease_s: float) -> QueueNow:
        with _mapped():
            return read_queue(
                self.connection,
                {name: place_of(name) for name in known_lists(self.connection)},
                workers_key=WORKERS,
                worker_key=_WORKER,
                lease_s=lease_s,
                read_beat=entries.beat,
            )

    def count(self, amounts: Mapping[str, float]) -> None:
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            for name, amount in amounts.items():
                pipe.hincrbyfloat(METRICS, name, amount)
            pipe.execute()

    def counted(self) -> dict[str, float]:
        with _mapped():
            found = self.connection.hgetall(METRICS)
        return {entries.text(name): amount for name, raw in found.items() if (amount := _amount(raw)) is not None}

    def tidy(self) -> None:
        # RQ's registries of workers and failures are emptied by its own maintenance, which is off.
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            entries.sweep(self.connection, _KINDS, (EVENTS,))
            lists = known_lists(self.connection)
            entries.sweep(self.connection, rq_keys.kinds(lists))
            known = list(self.connection.smembers(WORKERS))
            for name in known:
                pipe.exists(_WORKER + name)
            for name, lives in zip(known, pipe.execute(), strict=True):
                if not lives:
                    key = rq_keys.worker_key(entries.text(name))
                    pipe.delete(key)
                    for registry in (rq_keys.WORKERS, *map(rq_keys.workers_key, lists)):
                        pipe.srem(registry, key)
                    pipe.srem(WORKERS, name)
            for queue in lists:
                pipe.zremrangebyscore(rq_keys.failed_key(queue), 0, time.time())
            pipe.execute()

    def close(self) -> None:
        self.connection.close()

    def _job(self, message: Message) -> Job:
        return new_job(
            TASK_FUNCTION,
            message.model_dump(mode="json", by_alias=True),
            id=rq_id(message.task_id, message.attempt),
            connection=self.connection,
            description=f"{message.stage} {message.task_id}",
        )

    def _list_keys(self) -> list[str]:
        return [list_key(name) for name in known_lists(self.connection)]


def open_queue(settings: Settings, *, patience: int = 3) -> RqQueue:
    """The queue that the settings name; it need not answer yet."""
    return RqQueue(connect(redis_url(settings), patience=patience))


def rq_id(task_id: str, attempt: int) -> str:
    """RQ's job id: one a task and attempt, so that a slow worker's end cannot touch the attempt that replaced it."""
    return f"{task_id}-{attempt}"


def cancel_key(task_id: str) -> str:
    """Key that tells a worker to stop a task."""
    return f"graspd:cancel:{task_id}"


def lease_state(connection: Any, job: Job, execution: Execution) -> tuple[bool, bool]:
    """Whether a task in hand is still its worker's, and whether it is cancelled. Reading changes nothing."""
    with connection.pipeline(transaction=False) as pipe:
        pipe.zscore(job.started_job_registry.key, execution.composite_key)
        pipe.exists(cancel_key(entries.task_of(job.id)[0]))
        score, cancelled = pipe.execute()
    return score is not None, bool(cancelled)


def renew_lease(pipe: Any, job: Job, execution: Execution, ttl: int) -> None:
    """A sign of life for a task in hand. RQ notes whole seconds, and a lease may be as short."""
    registry = job.started_job_registry
    execution.heartbeat(registry, ttl, pipe)
    pipe.zadd(registry.key, {execution.composite_key: time.time() + ttl}, xx=True)


def list_worker(connection: Any, beat: Mapping[str, Any], lease_s: float) -> int:
    """Register a worker for the length of a lease [s]; returns how many are listed."""
    with connection.pipeline() as pipe:
        pipe.set(worker_key(beat["name"]), json.dumps(beat), ex=max(2, round(lease_s)))
        pipe.sadd(WORKERS, beat["name"])
        pipe.scard(WORKERS)
        return int(pipe.execute()[2])


def unlist_worker(connection: Any, left: Event) -> None:
    """End a worker's registration with the event that says so."""
    with connection.pipeline() as pipe:
        pipe.delete(worker_key(left.worker))
        pipe.srem(WORKERS, left.worker)
        put_event(pipe, left)
        pipe.execute()


def _lease(key: str, entry: bytes, score: float) -> Lease:
    task, attempt = entries.task_of(entries.text(entry.partition(b":")[0]))
    # Every sign of life moves the score, and an entry is of one execution only.
    return Lease(task_id=task, attempt=attempt, key=f"{key} {entry.hex()}", beat=str(score))


def worker_key(name: str) -> str:
    """Key that a living worker keeps alive."""
    return f"{_WORKER.decode()}{name}"


def _part_key(part: str) -> str:
    return f"graspd:part:{part}"


#: Names of a fixed number, each with its type in Redis.
_KINDS: Final = (
    (EVENTS, "stream"),
    (LEAD, "string"),
    (WORKERS, "set"),
    (METRICS, "hash"),
    (REPORTS, "hash"),
    (_SERVICE, "string"),
    (rq_keys.WORKERS, "set"),
    (LISTS, "set"),
)


def _amount(raw: bytes) -> float | None:
    try:
        return float(raw)
    except ValueError:
        return None


@contextmanager
def _mapped() -> Iterator[None]:
    try:
        yield
    except (RedisError, OSError) as error:
        line = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise QueueUnavailable(f"Redis does not answer ({line}); start `graspd up`, or set GRASPD_REDIS_URL") from None
