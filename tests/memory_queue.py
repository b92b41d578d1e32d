"""The queue in one process: the twin that unit tests use, and what the contract test holds against Redis."""

from __future__ import annotations

import itertools
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from service.model.keeper_shards import ALL_SHARDS, KeeperShards, shard_of
from service.model.states import Lane, Stage
from service.model.worker_beat import WorkerBeat
from service.queue.at_scrape import QueueNow, WorkerPulse
from service.queue.port import (
    Event,
    Holder,
    Keeping,
    Lease,
    Message,
    Report,
    Share,
    lane_order,
    part_of,
)


@dataclass
class Delivery:
    """A task in a worker's hands."""

    message: Message
    worker: str
    key: str
    beat: int = 0


@dataclass
class MemoryQueue:
    """`TaskQueue` without Redis. `take`, `beat` and `finish` are the worker's side."""

    clock: Callable[[], float] = time.monotonic
    _lanes: dict[Lane, list[Message]] = field(default_factory=lambda: {lane: [] for lane in Lane})
    _held: dict[str, Delivery] = field(default_factory=dict)
    _cancelled: set[str] = field(default_factory=set)
    _streams: dict[int, list[Event]] = field(default_factory=lambda: defaultdict(list))
    _workers: dict[str, WorkerBeat] = field(default_factory=dict)
    _announced: dict[str, float] = field(default_factory=dict)
    _service: str | None = None
    _leases: dict[int, tuple[str, float]] = field(default_factory=dict)
    _keepers: dict[tuple[int, str], float] = field(default_factory=dict)
    _number: int = 1
    _reports: dict[str, Report] = field(default_factory=dict)
    _sums: dict[str, float] = field(default_factory=dict)
    _taken: Counter[str] = field(default_factory=Counter)
    _read: Counter[int] = field(default_factory=Counter)
    _acknowledged: set[str] = field(default_factory=set)
    _numbers: itertools.count[int] = field(default_factory=itertools.count)
    _changed: threading.Condition = field(default_factory=threading.Condition)

    def ping(self) -> float:
        return 0.0

    def enqueue(self, messages: Sequence[Message], lane: Lane, *, again: bool = False, apart: bool = False) -> int:
        # Its workers are those of a test, which take what they want.
        known = {(m.task_id, m.attempt) for waiting in self._lanes.values() for m in waiting}
        if not again:
            known |= {(held.message.task_id, held.message.attempt) for held in self._held.values()}
        fresh = [m for m in messages if (m.task_id, m.attempt) not in known]
        self._cancelled -= {m.task_id for m in messages}
        self._lanes[lane] += fresh
        return len(fresh)

    def discard(self, task_ids: Collection[str]) -> None:
        self._cancelled |= set(task_ids)
        for lane, waiting in self._lanes.items():
            self._lanes[lane] = [m for m in waiting if m.task_id not in set(task_ids)]

    def waiting(self) -> set[str]:
        return {m.task_id for waiting in self._lanes.values() for m in waiting}

    def depths(self) -> dict[tuple[Lane, Stage], int]:
        return {(lane, s): sum(m.stage is s for m in waiting) for lane, waiting in self._lanes.items() for s in Stage}

    def clear_untaken(self, present: Collection[WorkerBeat]) -> None:
        pass

    def leases(self) -> list[Lease]:
        return [
            Lease(held.message.task_id, held.message.attempt, held.key, str(held.beat)) for held in self._held.values()
        ]

    def holder(self, lease: Lease) -> Holder:
        held = self._held.get(lease.key)
        return Holder(held.worker, held.message) if held else Holder("", None)

    def release(self, lease: Lease) -> None:
        self._held.pop(lease.key, None)
        self._reports.pop(lease.task_id, None)

    def workers(self) -> list[WorkerBeat]:
        return list(self._workers.values())

    def publish(self, *events: Event) -> None:
        with self._changed:
            for event in events:
                self._streams[shard_of(event.job_id, self._number)].append(event)
            self.forget_reports([event.task_id for event in events if event.kind.ends_attempt])
            self._changed.notify_all()

    def hand_on(self, events: Iterable[tuple[int, Event]]) -> None:
        with self._changed:
            for shard, event in events:
                self._streams[shard].append(event)
            self._changed.notify_all()

    def report(self, task_id: str, report: Report) -> float:
        self._reports[task_id] = report
        return 0.0

    def reports(self, shards: KeeperShards = ALL_SHARDS) -> dict[str, Report]:
        return {task: report for task, report in self._reports.items() if shards.has(task)}

    def forget_reports(self, task_ids: Collection[str]) -> None:
        for task in task_ids:
            self._reports.pop(task, None)

    def consume(self, *, limit: int, wait_s: float, shards: Collection[int] = (0,)) -> list[tuple[str, Event]]:
        with self._changed:
            self._changed.wait_for(lambda: any(self._unread(shard) for shard in shards), timeout=wait_s)
            found = [one for shard in shards for one in self._unread(shard)][:limit]
            for event_id, _ in found:
                self._read[int(event_id.partition("/")[0])] += 1
            return found

    def _unread(self, shard: int) -> list[tuple[str, Event]]:
        return [(f"{shard}/{i + 1}", e) for i, e in enumerate(self._streams[shard]) if i >= self._read[shard]]

    def acknowledge(self, event_ids: Sequence[str]) -> None:
        self._acknowledged |= set(event_ids)

    def left_over(self, number: int) -> list[int]:
        return [shard for shard in list(self._streams) if shard >= number and self._unread(shard)]

    def restart_consumer(self) -> None:
        """What a new keeper sees: everything that was not acknowledged."""
        for shard, events in self._streams.items():
            left = (i for i in range(len(events)) if f"{shard}/{i + 1}" not in self._acknowledged)
            self._read[shard] = next(left, len(events))

    def tail(self, after: str, *, limit: int, wait_s: float) -> list[tuple[str, Event]]:
        with self._changed:
            events = self._streams[0]
            start = len(events) if after == "$" else int(after)
            self._changed.wait_for(lambda: len(events) > start, timeout=wait_s)
            return [(str(i + 1), e) for i, e in enumerate(events) if i >= start][:limit]

    def announce(self, part: str, seconds: float) -> None:
        self._announced[part] = self.clock() + seconds

    def announced(self, part: str) -> bool:
        return self._announced.get(part, 0.0) > self.clock()

    def service(self) -> str | None:
        return self._service

    def set_service(self, identity: str, *, instead: bool = False) -> None:
        if instead or self._service is None:
            self._service = identity

    def take_share(self, holder: str, seconds: float, *, number: int, before: Collection[int] = ()) -> Share:
        with self._changed:
            now = self.clock()
            self._leases = {shard: held for shard, held in self._leases.items() if held[1] > now}
            self._keepers = {one: until for one, until in self._keepers.items() if until > now}
            self._keepers[number, holder] = now + seconds
            if self._number != number:
                if self._leases.get(0, (holder, now))[0] != holder:
                    return Share(self._number)
                self._number = number
            holds = Counter(by for shard, (by, _) in self._leases.items() if shard < number)
            others = sorted((name for of, name in self._keepers if of == number), key=lambda name: (-holds[name], name))
            fair = number // len(others) + (others.index(holder) < number % len(others))
            held = {shard for shard, (by, _) in self._leases.items() if by == holder and shard < number}
            free = [shard for shard in (*sorted(before), *range(number)) if shard not in self._leases]
            held |= set(list(dict.fromkeys(free))[: max(0, fair - len(held))])
            self._leases |= dict.fromkeys(held, (holder, now + seconds))
            return Share(number, fair, frozenset(held))

    def resign(self, holder: str, shards: Collection[int]) -> None:
        with self._changed:
            for shard in shards:
                if self._leases.get(shard, ("", 0.0))[0] == holder:
                    del self._leases[shard]

    def leave(self, holder: str, *, number: int) -> None:
        with self._changed:
            self._keepers.pop((number, holder), None)

    def keepers(self, part: str) -> list[Keeping]:
        return [
            Keeping(shard, self._leases.get(shard, ("", 0.0))[0], self.announced(part_of(part, shard)))
            for shard in range(self._number)
        ]

    def now(self, *, lease_s: float) -> QueueNow:
        running = Counter((Lane.BULK, held.message.stage) for held in self._held.values())
        pulses = {name: WorkerPulse(beat.device, beat.state, 0.0) for name, beat in self._workers.items()}
        return QueueNow(depth=self.depths(), running=running, workers=pulses)

    def count(self, amounts: Mapping[str, float]) -> None:
        for name, amount in amounts.items():
            self._sums[name] = self._sums.get(name, 0.0) + amount

    def counted(self) -> dict[str, float]:
        return dict(self._sums)

    def tidy(self) -> None:
        """Nothing is left behind."""

    def close(self) -> None:
        """Nothing to give back."""

    def take(self, worker: str, *, wait_s: float = 0.0) -> Delivery | None:
        """The next task, in the order of `lane_order`; it is leased to the worker."""
        deadline = time.monotonic() + wait_s
        while True:
            for lane in lane_order(self._taken[worker]):
                if self._lanes[lane]:
                    self._taken[worker] += 1
                    message = self._lanes[lane].pop(0)
                    delivery = Delivery(message, worker, f"{message.task_id}/{next(self._numbers)}")
                    self._held[delivery.key] = delivery
                    return delivery
            if time.monotonic() >= deadline:
                return None
            time.sleep(0.01)

    def beat(self, delivery: Delivery) -> tuple[bool, bool]:
        """A sign of life. Returns whether the task was cancelled, and whether the lease is lost."""
        delivery.beat += 1
        return delivery.message.task_id in self._cancelled, delivery.key not in self._held

    def finish(self, delivery: Delivery) -> None:
        """The worker is done with the task, whatever came of it."""
        self._held.pop(delivery.key, None)
