"""A worker's registration."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from graspd.service.queue.port import EventKind
from graspd.service.queue.rq_queue import RqQueue
from graspd.worker.process.heartbeat import Heartbeat
from tests.fakes import beat_of
from tests.waiting import until

LEASE_S = 2.0


@pytest.fixture
def heart(rq_queue: RqQueue, redis_server: str, tmp_path: Path) -> Iterator[Heartbeat]:
    """A heart whose first beat was seen."""
    heart = Heartbeat(redis_server, beat_of(), lease_s=LEASE_S, alive=tmp_path / "alive")
    heart.start()
    until(rq_queue.workers, "the first beat")
    yield heart
    heart.stop()


def test_what_a_worker_is_at_is_shown_at_once(heart: Heartbeat, rq_queue: RqQueue, tmp_path: Path) -> None:
    until((tmp_path / "alive").exists, "its file is touched")
    heart.interval_s = 3600.0
    heart.update(state="busy", task_id="a")
    until(lambda: [(beat.state, beat.task_id) for beat in rq_queue.workers()] == [("busy", "a")], "the news")
    heart.update(done=1.0, total=4.0, message="descending")
    told = ("a", 1.0, 4.0, "descending")
    until(lambda: [(b.task_id, b.done, b.total, b.message) for b in rq_queue.workers()] == [told], "how far it is")


def test_a_worker_that_leaves_is_not_lost(heart: Heartbeat, rq_queue: RqQueue) -> None:
    heart.stop()
    assert rq_queue.workers() == []
    assert [event.kind for _, event in rq_queue.tail("0", limit=10, wait_s=0)] == [EventKind.LEFT]


def test_it_goes_on_when_redis_answers_again(heart: Heartbeat, rq_queue: RqQueue) -> None:
    rq_queue.connection.config_set("min-replicas-to-write", 1)
    try:
        until(lambda: rq_queue.workers() == [], "its registration ends")
    finally:
        rq_queue.connection.config_set("min-replicas-to-write", 0)
    until(rq_queue.workers, "it gives signs of life again")
