"""A lease that is held, renewed, lost and given back."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from service.heartbeat_file import HeartbeatFile
from service.model.errors import QueueUnavailable
from service.pipeline.leadership import Leadership
from tests.memory_queue import MemoryQueue


class Moody(MemoryQueue):
    """A queue whose Redis may be away."""

    away = False

    def lead(self, part: str, holder: str, seconds: float) -> bool:
        if self.away:
            raise QueueUnavailable("away")
        return super().lead(part, holder, seconds)


def leadership(queue: MemoryQueue, *, lease_s: float = 0.3, file: Path | None = None) -> Leadership:
    return Leadership(queue, "keeper", lease_s=lease_s, alive=HeartbeatFile(file))


def test_a_lease_is_renewed_for_as_long_as_it_is_held(tmp_path: Path) -> None:
    queue, stop = MemoryQueue(), threading.Event()
    mine, others = leadership(queue, lease_s=3.0), leadership(queue, lease_s=3.0)
    assert mine.wait(stop)
    with mine.held(stop) as over:
        deadline = time.monotonic() + 3.5
        while time.monotonic() < deadline:
            assert not queue.lead("keeper", others.holder, 3.0)
            time.sleep(0.1)
        assert not over.is_set()
        stop.set()
        assert over.wait(10)
    assert queue.lead("keeper", others.holder, 3.0), "it was given back"


def test_who_waits_lives_and_can_be_told_to_stop(tmp_path: Path) -> None:
    queue, stop = MemoryQueue(), threading.Event()
    queue.lead("keeper", "another", 600)
    waiting = leadership(queue, file=tmp_path / "alive")
    ended: list[bool] = []
    thread = threading.Thread(target=lambda: ended.append(waiting.wait(stop)))
    thread.start()
    deadline = time.monotonic() + 10
    while not (tmp_path / "alive").exists():
        assert time.monotonic() < deadline, "health checks would end it"
        time.sleep(0.01)
    stop.set()
    thread.join(10)
    assert ended == [False]


def test_a_lease_that_another_has_is_over_and_is_not_given_back() -> None:
    queue, stop = MemoryQueue(), threading.Event()
    mine = leadership(queue)
    assert mine.wait(stop)
    with mine.held(stop) as over:
        queue.resign("keeper", mine.holder)
        queue.lead("keeper", "another", 600)
        assert over.wait(10)
    assert not queue.lead("keeper", mine.holder, 600)


def test_while_redis_is_away_nobody_loses_the_lead() -> None:
    queue, stop = Moody(), threading.Event()
    mine = leadership(queue, lease_s=0.06)
    assert mine.wait(stop)
    with mine.held(stop) as over:
        queue.away = True
        assert not over.wait(0.3)
        queue.away = False
        assert not over.wait(0.1)
