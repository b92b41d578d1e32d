"""The queue in one process: the twin that unit tests use, and what the contract test holds against Redis."""

import itertools
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from graspd.service.model.messages import WorkerHeartbeat
from graspd.service.model.states import Priority, Stage
from graspd.service.queue.entries import parse_events
from graspd.service.queue.port import Event, Lease, Message, QueueStatus, priority_order
from graspd.service.queue.rq_queue import EVENTS, RqQueue


@dataclass
class Delivery:
    message: Message
    worker: str
    key: str
    beat: int = 0


@dataclass
class MemoryQueue(RqQueue):
    clock: Callable[[], float] = time.monotonic
    _priorities: dict[Priority, list[Message]] = field(default_factory=lambda: {priority: [] for priority in Priority})
    _held: dict[str, Delivery] = field(default_factory=dict)
    _cancelled: set[str] = field(default_factory=set)
    _stream: list[Event] = field(default_factory=list)
    _workers: dict[str, WorkerHeartbeat] = field(default_factory=dict)
    _announced: dict[str, float] = field(default_factory=dict)
    _service: str | None = None
    _lease: tuple[str, float] = ("", 0.0)
    _sums: dict[str, float] = field(default_factory=dict)
    _taken: Counter[str] = field(default_factory=Counter)
    _logs: dict[str, str] = field(default_factory=dict)
    _read: int = 0
    _acknowledged: set[str] = field(default_factory=set)
    _numbers: Iterator[int] = field(default_factory=itertools.count)
    _changed: threading.Condition = field(default_factory=threading.Condition)

    def ping(self) -> float:
        return 0.0

    def enqueue(self, messages: Sequence[Message], priority: Priority, *, again: bool = False, **_: object) -> int:
        known = {(m.task_id, m.attempt) for waiting in self._priorities.values() for m in waiting}
        if not again:
            known |= {(held.message.task_id, held.message.attempt) for held in self._held.values()}
        fresh = [m for m in messages if (m.task_id, m.attempt) not in known]
        self._cancelled -= {m.task_id for m in messages}
        self._priorities[priority] += fresh
        return len(fresh)

    def discard(self, task_ids: Collection[str]) -> None:
        self._cancelled |= set(task_ids)
        for priority, waiting in self._priorities.items():
            self._priorities[priority] = [m for m in waiting if m.task_id not in set(task_ids)]

    def waiting_tasks(self) -> set[str]:
        return {m.task_id for waiting in self._priorities.values() for m in waiting}

    def depths(self) -> dict[tuple[Priority, Stage], int]:
        counts = {(one, stage): 0 for one in Priority for stage in Stage}
        return counts | Counter((one, m.stage) for one, waiting in self._priorities.items() for m in waiting)

    def remove_unserved_lists(self, present: Collection[WorkerHeartbeat]) -> None:
        pass

    def leases(self) -> list[Lease]:
        held = self._held.values()
        return [Lease(one.message.task_id, one.message.attempt, one.key, str(one.beat)) for one in held]

    def lease_holder(self, lease: Lease) -> tuple[str, Message | None]:
        held = self._held.get(lease.key)
        return (held.worker, held.message) if held else ("", None)

    def release(self, lease: Lease) -> None:
        self._held.pop(lease.key, None)

    def workers(self) -> list[WorkerHeartbeat]:
        return list(self._workers.values())

    def publish(self, *events: Event) -> None:
        with self._changed:
            self._stream += events
            self._changed.notify_all()

    def consume(self, *, limit: int, wait_s: float) -> list[tuple[str, Event]]:
        with self._changed:
            self._changed.wait_for(lambda: len(self._stream) > self._read, timeout=wait_s)
            found = self._stream[self._read : self._read + limit]
            first, self._read = self._read, self._read + len(found)
            return [(str(first + i + 1), event) for i, event in enumerate(found)]

    def acknowledge(self, event_ids: Sequence[str]) -> None:
        self._acknowledged |= set(event_ids)

    def put_task_log(self, attempt: str, text: str) -> None:
        self._logs[attempt] = text

    def task_log(self, attempt: str) -> str:
        return self._logs.get(attempt, "")

    def restart_consumer(self) -> None:
        left = (i for i in range(len(self._stream)) if str(i + 1) not in self._acknowledged)
        self._read = next(left, len(self._stream))

    def announce(self, part: str, seconds: float) -> None:
        self._announced[part] = self.clock() + seconds

    def is_announced(self, part: str) -> bool:
        return self._announced.get(part, 0.0) > self.clock()

    def service_id(self) -> str | None:
        return self._service

    def set_service_id(self, identity: str, *, instead: bool = False) -> None:
        if instead or self._service is None:
            self._service = identity

    def renew_leadership(self, holder: str, seconds: float) -> bool:
        with self._changed:
            now = self.clock()
            if self._lease[0] != holder and self._lease[1] > now:
                return False
            self._lease = (holder, now + seconds)
            return True

    def resign(self, holder: str) -> None:
        with self._changed:
            if self._lease[0] == holder:
                self._lease = ("", 0.0)

    def status(self, *, lease_s: float) -> QueueStatus:
        running = Counter((Priority.BULK, held.message.stage) for held in self._held.values())
        pulses = {name: (beat, 0.0) for name, beat in self._workers.items()}
        return QueueStatus(depth=self.depths(), running=running, workers=pulses)

    def add_to_counters(self, amounts: Mapping[str, float]) -> None:
        for name, amount in amounts.items():
            self._sums[name] = self._sums.get(name, 0.0) + amount

    def counter_sums(self) -> dict[str, float]:
        return dict(self._sums)

    def remove_stale_keys(self) -> None:
        """Nothing is left behind."""

    def close(self) -> None:
        """Nothing to give back."""

    def take(self, worker: str) -> Delivery | None:
        for priority in priority_order(self._taken[worker]):
            if self._priorities[priority]:
                self._taken[worker] += 1
                message = self._priorities[priority].pop(0)
                delivery = Delivery(message, worker, f"{message.task_id}/{next(self._numbers)}")
                self._held[delivery.key] = delivery
                return delivery
        return None

    def beat(self, delivery: Delivery) -> tuple[bool, bool]:
        """A sign of life. Returns whether the task was cancelled, and whether the lease is lost."""
        delivery.beat += 1
        return delivery.message.task_id in self._cancelled, delivery.key not in self._held

    def finish(self, delivery: Delivery) -> None:
        self._held.pop(delivery.key, None)


def events_after(queue: RqQueue | MemoryQueue, after: str = "0") -> list[tuple[str, Event]]:
    """Return the events of this or the other queue after an id, by default all."""
    if isinstance(queue, MemoryQueue):
        return [(str(i + 1), event) for i, event in enumerate(queue._stream) if i >= int(after)]
    found = parse_events(queue.connection.xread({EVENTS: after}))
    return [(event_id, event) for event_id, event in found if event is not None]
