"""What a large fleet asks of Redis: round trips and rates that do not grow with its workers."""

from __future__ import annotations

import pytest

from service.model.clock import timestamp
from service.model.states import Lane, Stage
from service.queue.lists import queue_name
from service.queue.port import Event, EventKind, Report
from service.queue.rq_queue import REPORTS, RqQueue
from tests.fakes import message_for
from tests.memory_queue import MemoryQueue

WIP = f"rq:wip:{queue_name(Lane.BULK, Stage.SYNTHESIZE)}"


@pytest.fixture(params=["memory", "redis"])
def queue(request: pytest.FixtureRequest) -> MemoryQueue | RqQueue:
    return MemoryQueue() if request.param == "memory" else request.getfixturevalue("rq_queue")


def commands(queue: RqQueue) -> int:
    """Commands that Redis has done so far."""
    return int(queue.connection.info("stats")["total_commands_processed"])


def cost_of_a_sweep(queue: RqQueue) -> int:
    before = commands(queue)
    queue.leases()
    return commands(queue) - before


def test_all_leases_are_read_in_one_round_trip(rq_queue: RqQueue) -> None:
    rq_queue.connection.zadd(WIP, {"a-1:x": 1.0})
    few = cost_of_a_sweep(rq_queue)
    rq_queue.connection.zadd(WIP, {f"{number}-1:x": 1.0 for number in range(500)})
    assert len(rq_queue.leases()) == 501
    assert cost_of_a_sweep(rq_queue) == few


def test_tasks_are_added_together_and_none_twice(rq_queue: RqQueue) -> None:
    tasks = [message_for().model_copy(update={"task_id": f"{number:032x}"}) for number in range(700)]
    assert rq_queue.enqueue(tasks[:10], Lane.BULK) == 10
    assert rq_queue.enqueue(tasks, Lane.BULK) == 690
    assert rq_queue.waiting() == {task.task_id for task in tasks}
    assert sum(rq_queue.depths().values()) == 700
    rq_queue.connection.delete(f"rq:queue:{queue_name(Lane.BULK, Stage.SYNTHESIZE)}")
    assert rq_queue.enqueue(tasks, Lane.BULK) == 0, "what the queue knows is not added again"
    assert rq_queue.enqueue(tasks, Lane.BULK, again=True) == 700


def test_a_report_replaces_the_last_and_goes_with_the_attempt(queue: MemoryQueue | RqQueue) -> None:
    queue.report("a", Report(attempt=1, done=1.0, total=4.0, message="descending"))
    queue.report("b", Report(attempt=1, done=1.0))
    queue.report("a", Report(attempt=1, done=2.0, total=4.0))
    assert queue.reports()["a"] == Report(attempt=1, done=2.0, total=4.0)
    queue.publish(Event(kind=EventKind.FINISHED, at=timestamp(), task_id="a"))
    assert set(queue.reports()) == {"b"}
    queue.forget_reports(["b"])
    assert queue.reports() == {}


@pytest.mark.parametrize("data", [b"\xff", b"[]", b'{"done": -1}', b'{"total": 1e400}'])
def test_a_report_that_cannot_be_read_says_nothing(rq_queue: RqQueue, data: bytes) -> None:
    rq_queue.connection.hset(REPORTS, "a", data)
    assert rq_queue.reports() == {"a": Report()}


def test_unreadable_events_stay_nobodys_work(rq_queue: RqQueue) -> None:
    rq_queue.connection.xadd("graspd:events", {"e": "rubbish"})
    rq_queue.publish(Event(kind=EventKind.STARTED, at=timestamp(), task_id="a"))
    ((event_id, _),) = rq_queue.consume(limit=9, wait_s=0)
    rq_queue.acknowledge([event_id])
    assert rq_queue.connection.xpending("graspd:events", "keeper")["pending"] == 0
