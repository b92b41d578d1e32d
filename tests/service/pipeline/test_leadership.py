"""A lease that is held, renewed, lost and given back."""

from __future__ import annotations

import threading
from pathlib import Path

from service.heartbeat_file import HeartbeatFile
from service.model.errors import QueueUnavailable
from service.pipeline.leadership import Leadership
from tests.memory_queue import MemoryQueue
from tests.waiting import PATIENCE_S, until

LEASE_S = 3.0


class Moody(MemoryQueue):
    """A queue whose Redis may be away; asked so many times while it is."""

    away = False
    asked = 0

    def lead(self, part: str, holder: str, seconds: float) -> bool:
        if self.away:
            self.asked += 1
            raise QueueUnavailable("away")
        return super().lead(part, holder, seconds)


class Pauses(threading.Event):
    """A word to stop, for which nobody waits: each pause moves the clock on, and a rival, if there is one, tries to
    lead at its end. The word comes after 20 pauses."""

    def __init__(self, *, rival: bool) -> None:
        super().__init__()
        self.rival = rival
        self.queue = MemoryQueue(clock=lambda: self.now)
        self.now, self.count = 0.0, 0
        self.taken: list[float] = []
        """When the rival came to lead."""

    def wait(self, timeout: float | None = None) -> bool:
        self.now += timeout or 0.0
        self.count += 1
        if self.rival and self.queue.lead("keeper", "rival", LEASE_S):
            self.taken.append(self.now)
        if self.count == 20:
            self.set()
        return self.is_set()


def leadership(queue: MemoryQueue, *, lease_s: float = 0.3, file: Path | None = None) -> Leadership:
    return Leadership(queue, "keeper", lease_s=lease_s, alive=HeartbeatFile(file))


def test_a_lease_is_renewed_for_as_long_as_it_is_held() -> None:
    stop = Pauses(rival=True)
    mine = leadership(stop.queue, lease_s=LEASE_S)
    assert mine.wait(stop)
    with mine.held(stop) as over:
        until(over.is_set, "it is told to stop")
        assert stop.now > 2 * LEASE_S and stop.taken == []
    assert stop.queue.lead("keeper", "rival", LEASE_S), "it was given back"


def test_who_waits_leads_within_a_lease_and_a_look_after_the_other_fell_silent() -> None:
    stop = Pauses(rival=False)
    stop.queue.lead("keeper", "silent", LEASE_S)
    assert leadership(stop.queue, lease_s=LEASE_S).wait(stop)
    assert LEASE_S <= stop.now <= LEASE_S * 4 / 3


def test_who_waits_lives_and_can_be_told_to_stop(tmp_path: Path) -> None:
    queue, stop = MemoryQueue(), threading.Event()
    queue.lead("keeper", "another", 600)
    waiting = leadership(queue, file=tmp_path / "alive")
    ended: list[bool] = []
    thread = threading.Thread(target=lambda: ended.append(waiting.wait(stop)))
    thread.start()
    until((tmp_path / "alive").exists, "what health checks look at")
    stop.set()
    thread.join(PATIENCE_S)
    assert ended == [False]


def test_a_lease_that_another_has_is_over_and_is_not_given_back() -> None:
    queue, stop = MemoryQueue(), threading.Event()
    mine = leadership(queue)
    assert mine.wait(stop)
    with mine.held(stop) as over:
        queue.resign("keeper", mine.holder)
        queue.lead("keeper", "another", 600)
        assert over.wait(PATIENCE_S)
    assert not queue.lead("keeper", mine.holder, 600)


def test_while_redis_is_away_nobody_loses_the_lead() -> None:
    queue, stop = Moody(), threading.Event()
    mine = leadership(queue, lease_s=0.06)
    assert mine.wait(stop)
    with mine.held(stop) as over:
        queue.away = True
        until(lambda: queue.asked > 10, "it is away for longer than a lease")
        queue.away = False
        assert not over.wait(0.1)
