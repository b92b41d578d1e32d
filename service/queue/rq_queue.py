"""The queue on Redis: RQ for tasks and leases, a bounded stream for events.

One RQ queue for each priority and stage: a worker may serve some stages only. RQ's own retries, scheduler, maintenance
and result storage are not used: each of them loses or repeats work in ways the controller does not.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, Final

from redis import Redis
from redis.exceptions import LockError, RedisError, ResponseError
from rq import Queue
from rq.exceptions import DuplicateJobError
from rq.executions import Execution
from rq.job import Job
from rq.serializers import JSONSerializer

from graspd.service.model.clock import age_of
from graspd.service.model.errors import QueueUnavailable
from graspd.service.model.renamed import for_worker_of
from graspd.service.model.states import Priority, Stage
from graspd.service.model.workers import WorkerBeat, need_of
from graspd.service.queue import entries
from graspd.service.queue.allowed import new_job
from graspd.service.queue.connection import connect, redis_url
from graspd.service.queue.lists import (
    LISTS,
    RQ_WORKERS,
    execution_keys,
    held_key,
    job_key,
    kinds,
    known_lists,
    list_key,
    place_of,
    queue_name,
    rq_worker_key,
    without_takers,
    workers_key,
)
from graspd.service.queue.port import Event, Lease, Message, Place, QueueStatus
from graspd.service.settings import Settings

EVENTS: Final = "graspd:events"
#: Events kept, 20 MB at most: a minute of a controller that is away and four hundred tasks a second. Lost ones are
#: made good from the store.
EVENTS_KEPT: Final = 50_000
#: Group of readers, by the name that graspd 0.2 gave it: a controller goes on where one of 0.2 ended.
_GROUP: Final = "keeper"
WORKERS: Final = "graspd:workers"
#: Lease of the controller that leads. A graspd of 0.2 takes and keeps the same one: so the two give way to each other.
LEAD: Final = "graspd:lead:keeper"
#: Sums for Prometheus, a few hundred fields.
METRICS: Final = "graspd:metrics"
_SERVICE: Final = "graspd:service"
_CANCEL_TTL_S: Final = 24 * 3600
_WORKER: Final = b"graspd:worker:"


class RqQueue:
    """Tasks to workers and who holds which, events, who is there, and sums.

    Every method raises QueueUnavailable when Redis is away. Nothing here is the truth: whatever is lost is queued again
    from the index.
    """

    def __init__(self, connection: Redis) -> None:
        self.connection: Any = connection
        self._queues: dict[str, Queue] = {}
        self._unread = "0"
        """Up to where what an earlier controller took was read; ">": all of it."""
        self._leases: dict[str, Any] = {}
        """Locks of those who lead, or want to, through this connection."""

    def ping(self) -> float:
        """Seconds a round trip takes."""
        start = time.perf_counter()
        with _mapped():
            self.connection.ping()
        return time.perf_counter() - start

    def enqueue(
        self, messages: Sequence[Message], priority: Priority, *, again: bool = False, apart: bool = False
    ) -> int:
        """Append tasks to a priority. A task (by id and attempt) that already waits or runs is not queued twice.

        Args:
            again: the caller has seen that the queue lost these tasks; what it still remembers of them is replaced.
            apart: only some workers of the stage can do them, and only those see them.

        Returns:
            number of tasks added.
        """
        stale = [cancel_key(message.task_id) for message in messages]
        if again:
            stale += [job_key(rq_id(message.task_id, message.attempt)) for message in messages]
        added = 0
        with _mapped():
            if stale:
                self.connection.delete(*stale)
            for message in messages:
                name = queue_name(priority, message.stage, need_of(message) if apart else None)
                if name not in self._queues:
                    self._queues[name] = Queue(name, self.connection, serializer=JSONSerializer)
                with suppress(DuplicateJobError):
                    self._queues[name].enqueue_job(self._job(message), unique=True)
                    added += 1
        return added

    def discard(self, task_ids: Collection[str]) -> None:
        """Take waiting tasks off the queue and tell the workers that run one of them to stop at the next launch."""
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
        """Ids of the tasks in the queue."""
        with _mapped(), self.connection.pipeline(transaction=True) as pipe:
            for key in self._list_keys():
                pipe.lrange(key, 0, -1)
            return {entries.task_of(entries.text(job))[0] for jobs in pipe.execute() for job in jobs}

    def depths(self) -> dict[tuple[Priority, Stage], int]:
        """Number of waiting tasks of each priority and stage."""
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            lists = known_lists(self.connection)
            for name in lists:
                pipe.llen(list_key(name))
            depths: Counter[tuple[Priority, Stage]] = Counter()
            for name, length in zip(lists, pipe.execute(), strict=True):
                depths[place_of(name)] += length
            return dict(depths)

    def clear_untaken(self, present: Collection[WorkerBeat]) -> None:
        """Forget tasks that wait apart for workers of a kind that is gone. The controller then finds them missing."""
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
        """Tasks held by workers, living or dead. Reading changes nothing."""
        # RQ's own readers clean up as they read, which moves lost tasks aside and runs callbacks; so the keys are read.
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            keys = [held_key(name) for name in known_lists(self.connection)]
            for key in keys:
                pipe.zrange(key, 0, -1, withscores=True)
            found = pipe.execute()
        # Every sign of life moves the score, and an entry is of one execution only.
        return [
            Lease(*entries.task_of(entries.text(entry.partition(b":")[0])), key=(key, entry), beat=str(score))
            for key, held in zip(keys, found, strict=True)
            for entry, score in held
        ]

    def holder(self, lease: Lease) -> tuple[str, Message | None]:
        """Which worker holds a lease, and what was asked of it; None if Redis no longer knows.

        Only of one that is lost is this asked: reading all leases stays one round trip.
        """
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            pipe.hmget(job_key(entries.text(lease.key[1].partition(b":")[0])), "worker_name", "data")
            (found,) = pipe.execute(raise_on_error=False)  # something else may stand under its name
        worker, data = (None, None) if isinstance(found, Exception) else found
        return entries.text(worker), entries.message(data)

    def release(self, lease: Lease) -> None:
        """Forget a lease whose worker is lost; if it lives after all, it notices and stops."""
        key, entry = lease.key
        name = entries.text(entry)
        with _mapped(), self.connection.pipeline(transaction=True) as pipe:
            pipe.zrem(key, entry)
            pipe.delete(*execution_keys(name), job_key(name.partition(":")[0]))
            pipe.execute()

    def workers(self) -> list[WorkerBeat]:
        """Workers that gave a sign of life within the last lease."""
        with _mapped():
            names = sorted(self.connection.smembers(WORKERS))
            found = self.connection.mget([_WORKER + name for name in names]) if names else []
        return [beat for data in found if (beat := entries.read(WorkerBeat, data)) is not None]

    def publish(self, *events: Event) -> None:
        """Append events."""
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            for event in events:
                put_event(pipe, event)
            pipe.execute()

    def consume(self, *, limit: int, wait_s: float) -> list[tuple[str, Event]]:
        """Next events for the controller, the oldest first; those never acknowledged come again to the next one."""
        with _mapped():
            while self._unread != ">":
                pending = self._of_group(self._unread, limit, 0.0)
                self._unread = pending[-1][0] if pending else ">"
                if known := self._known(pending):
                    return known
            return self._known(self._of_group(">", limit, wait_s))

    def acknowledge(self, event_ids: Sequence[str]) -> None:
        """Say that the events are in the index."""
        if event_ids:
            with _mapped():
                self.connection.xack(EVENTS, _GROUP, *event_ids)

    def tail(self, after: str, *, limit: int, wait_s: float) -> list[tuple[str, Event]]:
        """Events after an id, for any number of readers. `"$"`: only what comes from now on; `"0"`: all kept."""
        with _mapped():
            found = self.connection.xread({EVENTS: after}, count=limit, block=int(wait_s * 1000) or None)
        return [(event_id, event) for event_id, event in entries.events(found) if event is not None]

    def announce(self, part: str, seconds: float) -> None:
        """Say that a part of the service (the controller) lives, for that long."""
        with _mapped():
            self.connection.set(_part_key(part), "1", px=int(seconds * 1000))

    def announced(self, part: str) -> bool:
        """Whether a part said so."""
        with _mapped():
            return bool(self.connection.exists(_part_key(part)))

    def service(self) -> str | None:
        """Identity of the service that this queue belongs to; None if none has it yet, or Redis was lost."""
        with _mapped():
            found = self.connection.get(_SERVICE)
        return None if found is None else entries.text(found)

    def set_service(self, identity: str, *, instead: bool = False) -> None:
        """Say which service the queue belongs to, where nobody said it before or `instead` of that."""
        with _mapped():
            self.connection.set(_SERVICE, identity, nx=not instead)

    def lead(self, holder: str, seconds: float) -> bool:
        """Lead the controllers for that long, or go on to; False: another one does."""
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
        """Lead no longer; nothing happens where this one does not."""
        with _mapped(), suppress(LockError):
            self.connection.lock(LEAD).do_release(holder)

    def now(self, *, lease_s: float) -> QueueStatus:
        """Lengths, ages and workers for the metrics, at a cost that does not grow with the queue.

        Args:
            lease_s: how long a worker's registration outlives its beat [s].
        """
        beats = self.workers()
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            lists = known_lists(self.connection)
            for name in lists:
                pipe.llen(list_key(name))
                pipe.lindex(list_key(name), 0)
                pipe.zcard(held_key(name))
            found = pipe.execute()
            for head in found[1::3]:
                pipe.hget(job_key(entries.text(head)), "enqueued_at")
            for beat in beats:
                pipe.pttl(worker_key(beat.name))
            # Under a name that anybody may have put there lies anything: that hides no other.
            since = [None if isinstance(one, Exception) else one for one in pipe.execute(raise_on_error=False)]
        depth, running, oldest = Counter[Place](), Counter[Place](), dict[Place, float]()
        for place, waiting, held, when in zip(map(place_of, lists), found[0::3], found[2::3], since, strict=False):
            depth[place] += waiting
            running[place] += held
            if (age := age_of(entries.text(when))) is not None:
                oldest[place] = max(age, oldest.get(place, 0.0))
        workers = {
            beat.name: (beat, max(0.0, lease_s - (left_ms or 0) / 1000))
            for beat, left_ms in zip(beats, since[len(lists) :], strict=True)
        }
        return QueueStatus(depth, oldest, running, workers)

    def count(self, amounts: Mapping[str, float]) -> None:
        """Add to sums that outlive this process."""
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            for name, amount in amounts.items():
                pipe.hincrbyfloat(METRICS, name, amount)
            pipe.execute()

    def counted(self) -> dict[str, float]:
        """All those sums."""
        with _mapped():
            found = self.connection.hgetall(METRICS)
        sums: dict[str, float] = {}
        for name, raw in found.items():
            with suppress(ValueError):  # forged
                sums[entries.text(name)] = float(raw)
        return sums

    def tidy(self) -> None:
        """Throw away what dead workers and refused entries left behind."""
        # RQ's registries of workers are emptied by its own maintenance, which is off.
        with _mapped(), self.connection.pipeline(transaction=False) as pipe:
            lists = known_lists(self.connection)
            entries.sweep(self.connection, {**_KINDS, **kinds(lists)}, EVENTS)
            known = list(self.connection.smembers(WORKERS))
            for name in known:
                pipe.exists(_WORKER + name)
            for name, lives in zip(known, pipe.execute(), strict=True):
                if not lives:
                    key = rq_worker_key(entries.text(name))
                    pipe.delete(key)
                    for registry in (RQ_WORKERS, *map(workers_key, lists)):
                        pipe.srem(registry, key)
                    pipe.srem(WORKERS, name)
            pipe.execute()

    def close(self) -> None:
        """Give the connections back."""
        self.connection.close()

    def _of_group(self, after: str, limit: int, wait_s: float) -> list[tuple[str, Event | None]]:
        """Events of the group of controllers, which is made where there is none."""
        read = partial(
            self.connection.xreadgroup, _GROUP, _GROUP, {EVENTS: after}, count=limit, block=int(wait_s * 1000) or None
        )
        try:
            return entries.events(read())
        except ResponseError as error:
            if not str(error).startswith("NOGROUP"):
                raise
        with suppress(ResponseError):  # another one made it
            self.connection.xgroup_create(EVENTS, _GROUP, id="0", mkstream=True)
        return entries.events(read())

    def _known(self, found: Sequence[tuple[str, Event | None]]) -> list[tuple[str, Event]]:
        """Events that can be read. What cannot be is acknowledged: it is nobody's."""
        self.acknowledge([event_id for event_id, event in found if event is None])
        return [(event_id, event) for event_id, event in found if event is not None]

    def _job(self, message: Message) -> Job:
        return new_job(
            for_worker_of(
                getattr(message, "revision", 0), message.stage, message.model_dump(mode="json", by_alias=True)
            ),
            id=rq_id(message.task_id, message.attempt),
            connection=self.connection,
            description=f"{message.stage} {message.task_id}",
        )

    def _list_keys(self) -> list[str]:
        return [list_key(name) for name in known_lists(self.connection)]


def open_queue(settings: Settings, *, patience: int = 3) -> RqQueue:
    """The queue that the settings name; it need not answer yet."""
    return RqQueue(connect(redis_url(settings), patience=patience))


def put_event(pipe: Any, event: Event) -> None:
    """Append an event to the bounded stream."""
    pipe.xadd(EVENTS, {"e": event.model_dump_json(exclude_defaults=True)}, maxlen=EVENTS_KEPT, approximate=True)


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


def list_worker(connection: Any, beat: Mapping[str, Any], lease_s: float) -> None:
    """Register a worker for the length of a lease [s]."""
    with connection.pipeline() as pipe:
        pipe.set(worker_key(beat["name"]), json.dumps(beat), ex=max(2, round(lease_s)))
        pipe.sadd(WORKERS, beat["name"])
        pipe.execute()


def unlist_worker(connection: Any, left: Event) -> None:
    """End a worker's registration with the event that says so."""
    with connection.pipeline() as pipe:
        pipe.delete(worker_key(left.worker))
        pipe.srem(WORKERS, left.worker)
        put_event(pipe, left)
        pipe.execute()


def worker_key(name: str) -> str:
    """Key that a living worker keeps alive."""
    return f"{_WORKER.decode()}{name}"


def _part_key(part: str) -> str:
    return f"graspd:part:{part}"


#: Names of a fixed number, each with its type in Redis.
_KINDS: Final = {
    **dict.fromkeys((LEAD, _SERVICE), "string"),
    **dict.fromkeys((WORKERS, RQ_WORKERS, LISTS), "set"),
    EVENTS: "stream",
    METRICS: "hash",
}


@contextmanager
def _mapped() -> Iterator[None]:
    try:
        yield
    except (RedisError, OSError) as error:
        line = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise QueueUnavailable(f"Redis does not answer ({line}); start `graspd up`, or set GRASPD_REDIS_URL") from None
