"""What a task and a grasp cost in Redis and in the index: the figures of docs/results/service.md, as limits."""

from __future__ import annotations

from pathlib import Path

from benchmarks.large_index import fill
from graspd.service.model.clock import timestamp
from graspd.service.model.states import Priority
from graspd.service.queue.port import Event, EventKind
from graspd.service.queue.rq_queue import EVENTS, EVENTS_KEPT, RqQueue, cancel_key
from graspd.service.store.store import open_store
from tests.fakes import message_for
from tests.indexes import empty_index

#: Redis memory of a waiting task [bytes]; at most GRASPD_QUEUE_WINDOW of them wait in each priority.
TASK_BYTES = 3000
#: Redis memory of an event [bytes]; at most EVENTS_KEPT are kept.
EVENT_BYTES = 500
#: Index on disk for each grasp, with its share of shard, task and job [bytes].
GRASP_BYTES = 1300


def used(queue: RqQueue) -> int:
    return int(queue.connection.info("memory")["used_memory_dataset"])


def test_a_waiting_task_takes_a_few_kilobytes_of_redis(rq_queue: RqQueue) -> None:
    message = message_for(scenes=2)
    tasks = [message.model_copy(update={"task_id": f"{number:032x}"}) for number in range(500)]

    def come_and_go() -> int:
        """Redis memory while the tasks wait [bytes]."""
        rq_queue.enqueue(tasks, Priority.BULK)
        full = used(rq_queue)
        rq_queue.discard([task.task_id for task in tasks])
        for task in tasks:  # as their time to live does
            assert 0 < rq_queue.connection.ttl(cancel_key(task.task_id)) <= 24 * 3600
            rq_queue.connection.delete(cancel_key(task.task_id))
        return full

    come_and_go()  # Redis keeps its tables at the size they once had
    before = used(rq_queue)
    assert come_and_go() - before < 500 * TASK_BYTES
    assert used(rq_queue) - before < 10 * TASK_BYTES


def test_the_stream_of_events_takes_a_bounded_part_of_redis(rq_queue: RqQueue) -> None:
    ids = {"task_id": "0" * 32, "job_id": "1" * 32, "output": "2" * 32, "worker": "host-12345-abcdef"}
    event = Event(kind=EventKind.FINISHED, at=timestamp(), attempt=1, seconds=12.5, message="was there already", **ids)
    for _ in range(1000):
        rq_queue.publish(event)
    size = rq_queue.connection.memory_usage(EVENTS, samples=0)
    assert size < 1000 * EVENT_BYTES
    assert EVENTS_KEPT * EVENT_BYTES <= 25e6


def test_an_index_grows_by_about_a_kilobyte_a_grasp(tmp_path: Path) -> None:
    index = empty_index(f"sqlite:///{tmp_path / 'index.sqlite'}")
    counts = fill(index, open_store("memory://"), grasps=16_000, jobs=20)
    index.close()
    assert (tmp_path / "index.sqlite").stat().st_size < counts["grasps"] * GRASP_BYTES


def test_everything_in_redis_of_no_fixed_number_has_an_end(rq_queue: RqQueue) -> None:
    rq_queue.enqueue([message_for()], Priority.BULK)
    rq_queue.discard(["0" * 32])
    rq_queue.announce("controller", 5)
    rq_queue.lead("a", 5)
    rq_queue.publish(Event(kind=EventKind.STARTED, at=timestamp(), task_id="a"))
    rq_queue.publish(Event(kind=EventKind.FINISHED, at=timestamp(), task_id="a"))
    fixed = ("rq:queue", "rq:job", "rq:unique", EVENTS, "graspd:workers", "graspd:tally")
    without_end = [key.decode() for key in rq_queue.connection.keys("*") if rq_queue.connection.ttl(key) < 0]
    assert [key for key in without_end if not key.startswith(fixed)] == []
