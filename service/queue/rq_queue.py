"""Queue on Redis: RQ for tasks and leases, a bounded stream for events.

Each pair of priority and stage has an RQ queue. RQ's retries, scheduler, maintenance and result storage are unused,
because they may lose or repeat tasks.
"""

import json
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, Final, TypeVar

from redis import Redis
from redis.exceptions import LockError, RedisError, ResponseError
from rq import Queue
from rq.exceptions import DuplicateJobError
from rq.executions import Execution
from rq.job import Job
from rq.serializers import JSONSerializer

from graspd.service.model.base import first_line
from graspd.service.model.clock import age_of
from graspd.service.model.errors import QueueUnavailable
from graspd.service.model.messages import WorkerHeartbeat, requirements_of
from graspd.service.model.renamed import message_for_revision
from graspd.service.model.states import Priority, Stage
from graspd.service.queue import entries
from graspd.service.queue.connection import connect, redis_url
from graspd.service.queue.port import MOST_LOG, Event, Lease, Message, Place, QueueStatus, rq_id
from graspd.service.settings import Settings

KindT = TypeVar("KindT")
EVENTS: Final = "graspd:events"
#: Maximum number of events (20 MB), enough for a minute without a controller at 400 tasks/s; the store restores others.
EVENTS_KEPT: Final = 50_000
#: Consumer group, named as in graspd 0.2, so that a controller continues where one of 0.2 ended.
_GROUP: Final = "keeper"
WORKERS: Final = "graspd:workers"
#: Lease of the leading controller. graspd 0.2 uses the same one, so both versions exclude each other.
LEAD: Final = "graspd:lead:keeper"
#: Sums for Prometheus, a few hundred fields.
METRICS: Final = "graspd:metrics"
_SERVICE: Final = "graspd:service"
_CANCEL_TTL_S: Final = 24 * 3600
#: Lifetime of the log of a task in Redis [s]; ended attempts have it in the store.
_LOG_TTL_S: Final = 3600
_WORKER: Final = b"graspd:worker:"
_LOG: Final = "graspd:log:"


@contextmanager
def _convert_errors() -> Iterator[None]:
    try:
        yield
    except (RedisError, OSError) as error:
        raise QueueUnavailable(
            f"Redis does not answer ({first_line(error)}); start `graspd up`, or set GRASPD_REDIS_URL"
        ) from None


def _converts_errors(kind: type[KindT]) -> type[KindT]:
    """Decorate a class: the errors of Redis in its public methods become QueueUnavailable."""
    for name, method in vars(kind).items():
        if not name.startswith("_"):
            setattr(kind, name, _convert_errors()(method))
    return kind


@_converts_errors
class RqQueue:
    """Tasks and their leases, events, living workers, and sums.

    Every method raises QueueUnavailable if Redis does not answer. Tasks lost here are queued again from the index.
    """

    def __init__(self, connection: Redis) -> None:
        self.connection: Any = connection
        self._queues: dict[str, Queue] = {}
        self._unread = "0"
        """Id of the last pending event of an earlier controller that was read; ">" once all were read."""
        self._leases: dict[str, Any] = {}

    def ping(self) -> float:
        """Return the round-trip time [s]."""
        start = time.perf_counter()
        self.connection.ping()
        return time.perf_counter() - start

    def enqueue(
        self, messages: Sequence[Message], priority: Priority, *, again: bool = False, apart: bool = False
    ) -> int:
        """Append tasks that neither wait nor run to the lists of a priority; return their number.

        `again` first deletes the data that missing tasks left in Redis. `apart` selects the separate lists.
        """
        stale = [cancel_key(message.task_id) for message in messages]
        if again:
            stale += [entries.job_key(rq_id(message.task_id, message.attempt)) for message in messages]
        added = 0
        if stale:
            self.connection.delete(*stale)
        for message in messages:
            name = entries.queue_name(priority, message.stage, requirements_of(message) if apart else None)
            if name not in self._queues:
                self._queues[name] = Queue(name, self.connection, serializer=JSONSerializer)
            with suppress(DuplicateJobError):
                self._queues[name].enqueue_job(self._job(message), unique=True)
                added += 1
        return added

    def discard(self, task_ids: Collection[str]) -> None:
        """Remove waiting tasks; ask workers that run one of them to stop at the next launch."""
        wanted = set(task_ids)
        with self.connection.pipeline(transaction=False) as pipe:
            for task in wanted:
                pipe.set(cancel_key(task), "1", ex=_CANCEL_TTL_S)
            pipe.execute()
            for key in self._list_keys():
                for job in self.connection.lrange(key, 0, -1):
                    if entries.split_rq_id(entries.decode_text(job))[0] in wanted:
                        pipe.lrem(key, 0, job)
                        pipe.delete(entries.job_key(entries.decode_text(job)))
            pipe.execute()

    def waiting_tasks(self) -> set[str]:
        with self.connection.pipeline(transaction=True) as pipe:
            for key in self._list_keys():
                pipe.lrange(key, 0, -1)
            return {entries.split_rq_id(entries.decode_text(job))[0] for jobs in pipe.execute() for job in jobs}

    def depths(self) -> dict[tuple[Priority, Stage], int]:
        with self.connection.pipeline(transaction=False) as pipe:
            lists = entries.list_names(self.connection)
            for name in lists:
                pipe.llen(entries.list_key(name))
            depths: Counter[tuple[Priority, Stage]] = Counter()
            for name, length in zip(lists, pipe.execute(), strict=True):
                depths[entries.priority_and_stage_of(name)] += length
            return dict(depths)

    def remove_unserved_lists(self, present: Collection[WorkerHeartbeat]) -> None:
        """Remove separate lists that no worker can serve; the controller queues their tasks again."""
        abilities = [(stage, beat.capabilities) for beat in present for stage in beat.stages]
        with self.connection.pipeline(transaction=False) as pipe:
            for name in entries.unserved_lists(entries.list_names(self.connection), abilities):
                key = entries.list_key(name)
                for job in self.connection.lrange(key, 0, -1):
                    pipe.delete(entries.job_key(entries.decode_text(job)))
                pipe.delete(key)
                # Leases of running tasks are read under the list's name.
                if not self.connection.exists(entries.lease_registry_key(name)):
                    pipe.srem(entries.LISTS, key)
            pipe.execute()

    def leases(self) -> list[Lease]:
        """Return the leases of all workers, living or dead; reading changes nothing."""
        # RQ's own readers also move lost tasks and run callbacks, so the keys are read directly.
        with self.connection.pipeline(transaction=False) as pipe:
            keys = [entries.lease_registry_key(name) for name in entries.list_names(self.connection)]
            for key in keys:
                pipe.zrange(key, 0, -1, withscores=True)
            found = pipe.execute()
        # Every heartbeat changes the score, and an entry belongs to one execution only.
        return [
            Lease(
                *entries.split_rq_id(entries.decode_text(entry.partition(b":")[0])), key=(key, entry), beat=str(score)
            )
            for key, held in zip(keys, found, strict=True)
            for entry, score in held
        ]

    def lease_holder(self, lease: Lease) -> tuple[str, Message | None]:
        """Return worker and message of a lost lease; "" or None if Redis has lost the data."""
        with self.connection.pipeline(transaction=False) as pipe:
            pipe.hmget(entries.job_key(entries.decode_text(lease.key[1].partition(b":")[0])), "worker_name", "data")
            (found,) = pipe.execute(raise_on_error=False)  # The name may have a value of another type.
        worker, data = (None, None) if isinstance(found, Exception) else found
        return entries.decode_text(worker), entries.parse_message(data)

    def release(self, lease: Lease) -> None:
        """Remove the lease of a lost worker; a worker that still lives detects the loss and stops."""
        key, entry = lease.key
        name = entries.decode_text(entry)
        with self.connection.pipeline(transaction=True) as pipe:
            pipe.zrem(key, entry)
            pipe.delete(*entries.execution_keys(name), entries.job_key(name.partition(":")[0]))
            pipe.execute()

    def workers(self) -> list[WorkerHeartbeat]:
        """Return the workers with a heartbeat within the last lease time."""
        names = sorted(self.connection.smembers(WORKERS))
        found = self.connection.mget([_WORKER + name for name in names]) if names else []
        return [beat for data in found if (beat := entries.parse_entry(WorkerHeartbeat, data)) is not None]

    def publish(self, *events: Event) -> None:
        with self.connection.pipeline(transaction=False) as pipe:
            for event in events:
                put_event(pipe, event)
            pipe.execute()

    def consume(self, *, limit: int, wait_s: float) -> list[tuple[str, Event]]:
        """Return the next events with their ids, oldest first, after those an earlier controller left."""
        while self._unread != ">":
            pending = self._read_group(self._unread, limit, 0.0)
            self._unread = pending[-1][0] if pending else ">"
            if known := self._readable_events(pending):
                return known
        return self._readable_events(self._read_group(">", limit, wait_s))

    def put_task_log(self, attempt: str, text: str) -> None:
        """Replace the log of an attempt, which has the id `rq_id(...)`."""
        self.connection.set(_LOG + attempt, text, ex=_LOG_TTL_S)

    def task_log(self, attempt: str) -> str:
        """Return the log of an attempt that runs or ended recently; "" without one."""
        return entries.decode_text(self.connection.get(_LOG + attempt))[:MOST_LOG]

    def acknowledge(self, event_ids: Sequence[str]) -> None:
        if event_ids:
            self.connection.xack(EVENTS, _GROUP, *event_ids)

    def announce(self, part: str, seconds: float) -> None:
        """Register a part of the service (the controller) as running for some seconds."""
        self.connection.set(_part_key(part), "1", px=int(seconds * 1000))

    def is_announced(self, part: str) -> bool:
        return bool(self.connection.exists(_part_key(part)))

    def service_id(self) -> str | None:
        """Return the identity of the service that owns this queue; None if unset, or lost by Redis."""
        found = self.connection.get(_SERVICE)
        return None if found is None else entries.decode_text(found)

    def set_service_id(self, identity: str, *, instead: bool = False) -> None:
        """Set the identity of the owning service; an existing one is replaced only with `instead`."""
        self.connection.set(_SERVICE, identity, nx=not instead)

    def renew_leadership(self, holder: str, seconds: float) -> bool:
        """Acquire or renew the controllers' leadership for some seconds; False if another controller leads."""
        new = self.connection.lock(LEAD, timeout=seconds, thread_local=False)
        lease = self._leases.setdefault(holder, new)
        lease.timeout = seconds
        try:
            if lease.owned():
                return bool(lease.reacquire())
            self.resign(holder)  # Lease of an ended process of the same name.
            if lease.acquire(blocking=False, token=holder):
                return True
            if self.connection.ttl(LEAD) == -1:  # A key without expiry is not a lease.
                self.connection.delete(LEAD)
        except LockError:
            pass
        except ResponseError as error:
            if not entries.is_type_error(error):
                raise
            self.connection.delete(LEAD)
        return False

    def resign(self, holder: str) -> None:
        with suppress(LockError):
            self.connection.lock(LEAD).do_release(holder)

    def status(self, *, lease_s: float) -> QueueStatus:
        """Return queue lengths, ages [s] and workers for the metrics, in constant time per list."""
        beats = self.workers()
        with self.connection.pipeline(transaction=False) as pipe:
            lists = entries.list_names(self.connection)
            for name in lists:
                pipe.llen(entries.list_key(name))
                pipe.lindex(entries.list_key(name), 0)
                pipe.zcard(entries.lease_registry_key(name))
            found = pipe.execute()
            for head in found[1::3]:
                pipe.hget(entries.job_key(entries.decode_text(head)), "enqueued_at")
            for beat in beats:
                pipe.pttl(worker_key(beat.name))
            # A name may have a forged value of any type, which must not hide the others.
            since = [None if isinstance(one, Exception) else one for one in pipe.execute(raise_on_error=False)]
        depth, running, oldest = Counter[Place](), Counter[Place](), dict[Place, float]()
        places = map(entries.priority_and_stage_of, lists)
        for place, waiting, held, when in zip(places, found[0::3], found[2::3], since, strict=False):
            depth[place] += waiting
            running[place] += held
            if (age := age_of(entries.decode_text(when))) is not None:
                oldest[place] = max(age, oldest.get(place, 0.0))
        workers = {
            beat.name: (beat, max(0.0, lease_s - (left_ms or 0) / 1000))
            for beat, left_ms in zip(beats, since[len(lists) :], strict=True)
        }
        return QueueStatus(depth, oldest, running, workers)

    def add_to_counters(self, amounts: Mapping[str, float]) -> None:
        with self.connection.pipeline(transaction=False) as pipe:
            for name, amount in amounts.items():
                pipe.hincrbyfloat(METRICS, name, amount)
            pipe.execute()

    def counter_sums(self) -> dict[str, float]:
        found = self.connection.hgetall(METRICS)
        sums: dict[str, float] = {}
        for name, raw in found.items():
            with suppress(ValueError):
                sums[entries.decode_text(name)] = float(raw)
        return sums

    def remove_stale_keys(self) -> None:
        """Remove keys of wrong types, and the registrations of dead workers, which RQ leaves."""
        with self.connection.pipeline(transaction=False) as pipe:
            lists = entries.list_names(self.connection)
            entries.remove_mistyped_keys(self.connection, {**_KINDS, **entries.key_types(lists)}, EVENTS)
            known = list(self.connection.smembers(WORKERS))
            for name in known:
                pipe.exists(_WORKER + name)
            for name, lives in zip(known, pipe.execute(), strict=True):
                if not lives:
                    key = entries.rq_worker_key(entries.decode_text(name))
                    pipe.delete(key)
                    for registry in (entries.RQ_WORKERS, *map(entries.workers_key, lists)):
                        pipe.srem(registry, key)
                    pipe.srem(WORKERS, name)
            pipe.execute()

    def close(self) -> None:
        self.connection.close()

    def _read_group(self, after: str, limit: int, wait_s: float) -> list[tuple[str, Event | None]]:
        """Read events of the controllers' consumer group; create the group if necessary."""
        block = int(wait_s * 1000) or None
        read = partial(self.connection.xreadgroup, _GROUP, _GROUP, {EVENTS: after}, count=limit, block=block)
        try:
            return entries.parse_events(read())
        except ResponseError as error:
            if not str(error).startswith("NOGROUP"):
                raise
        with suppress(ResponseError):
            self.connection.xgroup_create(EVENTS, _GROUP, id="0", mkstream=True)
        return entries.parse_events(read())

    def _readable_events(self, found: Sequence[tuple[str, Event | None]]) -> list[tuple[str, Event]]:
        """Return the readable events; acknowledge and discard the unreadable ones."""
        self.acknowledge([event_id for event_id, event in found if event is None])
        return [(event_id, event) for event_id, event in found if event is not None]

    def _job(self, message: Message) -> Job:
        data = message.model_dump(mode="json", by_alias=True)
        return entries.new_job(
            message_for_revision(getattr(message, "revision", 0), message.stage, data),
            id=rq_id(message.task_id, message.attempt),
            connection=self.connection,
            description=f"{message.stage} {message.task_id}",
        )

    def _list_keys(self) -> list[str]:
        return [entries.list_key(name) for name in entries.list_names(self.connection)]


def open_queue(settings: Settings, *, patience: int = 3) -> RqQueue:
    """Return the queue of the settings, without connecting yet."""
    return RqQueue(connect(redis_url(settings), patience=patience))


def put_event(pipe: Any, event: Event) -> None:
    pipe.xadd(EVENTS, {"e": event.model_dump_json(exclude_defaults=True)}, maxlen=EVENTS_KEPT, approximate=True)


def cancel_key(task_id: str) -> str:
    return f"graspd:cancel:{task_id}"


def lease_state(connection: Any, job: Job, execution: Execution) -> tuple[bool, bool]:
    """Return whether the worker still has the lease of its task, and whether the task is cancelled."""
    with connection.pipeline(transaction=False) as pipe:
        pipe.zscore(job.started_job_registry.key, execution.composite_key)
        pipe.exists(cancel_key(entries.split_rq_id(job.id)[0]))
        score, cancelled = pipe.execute()
    return score is not None, bool(cancelled)


def renew_lease(pipe: Any, job: Job, execution: Execution, ttl: int) -> None:
    """Renew the lease of a task. RQ stores whole seconds, and a lease may be as short as a second."""
    registry = job.started_job_registry
    execution.heartbeat(registry, ttl, pipe)
    pipe.zadd(registry.key, {execution.composite_key: time.time() + ttl}, xx=True)


def register_worker(connection: Any, beat: Mapping[str, Any], lease_s: float) -> None:
    with connection.pipeline() as pipe:
        pipe.set(worker_key(beat["name"]), json.dumps(beat), ex=max(2, round(lease_s)))
        pipe.sadd(WORKERS, beat["name"])
        pipe.execute()


def unregister_worker(connection: Any, left: Event) -> None:
    """Remove a worker's registration and append its event `left`."""
    with connection.pipeline() as pipe:
        pipe.delete(worker_key(left.worker))
        pipe.srem(WORKERS, left.worker)
        put_event(pipe, left)
        pipe.execute()


def worker_key(name: str) -> str:
    return f"{_WORKER.decode()}{name}"


def _part_key(part: str) -> str:
    return f"graspd:part:{part}"


_KINDS: Final = {
    **dict.fromkeys((LEAD, _SERVICE), "string"),
    **dict.fromkeys((WORKERS, entries.RQ_WORKERS, entries.LISTS), "set"),
    EVENTS: "stream",
    METRICS: "hash",
}
