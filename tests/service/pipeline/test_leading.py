"""The lease of the controller that leads is held, renewed, lost and given back."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from graspd.service.model.errors import QueueUnavailable
from graspd.service.pipeline.leading import Leadership
from graspd.service.telemetry import HeartbeatFile
from tests.memory_queue import MemoryQueue
from tests.waiting import PATIENCE_S, until


class Moody(MemoryQueue):
    """A queue whose Redis may be away."""

    away = False
    asked_in_vain = 0

    def lead(self, holder: str, seconds: float) -> bool:
        if self.away:
            self.asked_in_vain += 1
            raise QueueUnavailable("away")
        return super().lead(holder, seconds)


#: Longer than any test: no lease runs out on a busy machine.
LEASE_S = 600.0


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leases are renewed every 10 ms."""
    monkeypatch.setattr("graspd.service.pipeline.leading._RENEWALS", LEASE_S * 100)


class Pauses(threading.Event):
    """A word to stop, for which nobody waits: each pause moves the queue's clock on."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.queue = MemoryQueue(clock=lambda: self.now)

    def wait(self, timeout: float | None = None) -> bool:
        self.now += timeout or 0.0
        return self.is_set()


def leadership(queue: MemoryQueue, *, file: Path | None = None) -> Leadership:
    return Leadership(queue, lease_s=LEASE_S, alive=HeartbeatFile(file))


def test_a_lease_is_renewed_while_held_and_given_back() -> None:
    queue, stop = MemoryQueue(), threading.Event()
    mine = leadership(queue)
    assert mine.wait(stop)
    begun = queue._lease[1]
    with mine.held(stop) as over:
        until(lambda: queue._lease[1] > begun, "it is renewed")
        assert not queue.lead("another", 600)
        assert not over.is_set()
        stop.set()
        assert over.wait(PATIENCE_S)
    assert queue.lead("another", 600)


def test_who_waits_leads_soon_after_the_other_fell_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.service.pipeline.leading._RENEWALS", 3.0)
    stop = Pauses()
    stop.queue.lead("silent", LEASE_S)
    assert leadership(stop.queue).wait(stop)
    assert LEASE_S <= stop.now <= LEASE_S * 4 / 3


def test_who_waits_lives_and_can_be_told_to_stop(tmp_path: Path) -> None:
    queue, stop = MemoryQueue(), threading.Event()
    queue.lead("another", 600)
    waiting = leadership(queue, file=tmp_path / "alive")
    ended: list[bool] = []
    thread = threading.Thread(target=lambda: ended.append(waiting.wait(stop)))
    thread.start()
    until((tmp_path / "alive").exists, "health checks would end it")
    stop.set()
    thread.join(PATIENCE_S)
    assert ended == [False]


def test_a_lease_that_another_has_is_over_and_is_not_given_back() -> None:
    queue, stop = MemoryQueue(), threading.Event()
    mine = leadership(queue)
    assert mine.wait(stop)
    with mine.held(stop) as over:
        with queue._changed:
            queue._lease = ("another", queue.clock() + 600)
        assert over.wait(PATIENCE_S)
        stop.set()
    assert queue._lease[0] == "another"


def test_while_redis_is_away_nobody_loses_the_lead() -> None:
    queue, stop = Moody(), threading.Event()
    mine = leadership(queue)
    assert mine.wait(stop)
    with mine.held(stop) as over:
        queue.away = True
        until(lambda: queue.asked_in_vain > 3, "it tries again and again")
        queue.away = False
        begun = queue._lease[1]
        until(lambda: queue._lease[1] > begun, "it is renewed")
        assert not over.is_set()
        stop.set()
