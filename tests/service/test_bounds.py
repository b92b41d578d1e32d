"""What a task and a grasp cost in Redis and in the index: the figures of docs/results/service.md, as limits."""

from graspd.service.model.clock import timestamp
from graspd.service.model.states import Priority
from graspd.service.queue.port import Event, EventKind
from graspd.service.queue.rq_queue import EVENTS, RqQueue
from tests.fakes import message_for


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
