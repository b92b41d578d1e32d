"""The queue's contract, held against Redis and against its twin in memory."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any

import pytest
from rq import Queue, SimpleWorker
from rq.executions import prepare_execution
from rq.serializers import JSONSerializer

from graspd.service.model.clock import timestamp
from graspd.service.model.errors import QueueUnavailable
from graspd.service.model.messages import IngestMessage, TaskMessage
from graspd.service.model.states import Priority, Stage
from graspd.service.queue.connection import connect
from graspd.service.queue.entries import lease_registry_key, list_key, queue_name, queue_names
from graspd.service.queue.port import BULK_EVERY, Event, EventKind
from graspd.service.queue.rq_queue import EVENTS, LEAD, RqQueue, lease_state, register_worker, renew_lease, worker_key
from graspd.worker.process.heartbeat import Heartbeat
from graspd.worker.stages.context import StopReason
from tests.fakes import beat_of, message_for
from tests.memory_queue import MemoryQueue
from tests.waiting import until


def task(name: str = "a", *, stage: Stage = Stage.SYNTHESIZE, attempt: int = 1) -> TaskMessage:
    return message_for().model_copy(update={"task_id": name, "stage": stage, "attempt": attempt})


@dataclass
class Worker:
    """A worker's side of a queue: what it takes, its signs of life, and what it hears in return."""

    take: Callable[[], TaskMessage | None]
    beat: Callable[[], StopReason | None]
    finish: Callable[[], None]


def memory_worker(queue: MemoryQueue) -> Worker:
    held: list[Any] = []

    def take() -> TaskMessage | None:
        delivery = queue.take("w")
        held[:] = [delivery] if delivery else []
        return delivery.message if delivery else None  # type: ignore[return-value]

    def beat() -> StopReason | None:
        cancelled, lost = queue.beat(held[0])
        return StopReason.CANCELLED if cancelled else StopReason.LEASE_LOST if lost else None

    return Worker(take, beat, lambda: queue.finish(held[0]))


@dataclass
class RqSide:
    """RQ's worker without its loop: the very calls the loop makes, one at a time."""

    queue: RqQueue
    name: str = "w"
    execution: Any = None
    job: Any = None
    state: str = ""
    taken: int = 0

    @property
    def connection(self) -> Any:
        return self.queue.connection

    def get_heartbeat_ttl(self, job: Any) -> int:
        return 60

    def set_state(self, state: str, pipeline: Any = None) -> None:
        self.state = state

    def take(self) -> TaskMessage | None:
        names = queue_names(tuple(Stage), self.taken)
        queues = [Queue(name, self.connection, serializer=JSONSerializer) for name in names]
        found = Queue.dequeue_any(queues, None, connection=self.connection, serializer=JSONSerializer)
        if found is None:
            return None
        self.taken += 1
        self.job = found[0]
        prepare_execution(self, self.job)  # type: ignore[arg-type]
        with self.connection.pipeline() as pipe:
            self.job.prepare_for_execution(self.name, pipeline=pipe)
            pipe.execute()
        return TaskMessage.model_validate(self.job.args[0])

    def beat(self) -> StopReason | None:
        one_beat(self.connection, self.name)
        is_held, is_cancelled = lease_state(self.connection, self.job, self.execution)
        if is_held:
            with self.connection.pipeline() as pipe:
                renew_lease(pipe, self.job, self.execution, 60)
                pipe.execute()
        return StopReason.CANCELLED if is_cancelled else None if is_held else StopReason.LEASE_LOST

    def finish(self) -> None:
        with self.connection.pipeline() as pipe:
            self.execution.delete(job=self.job, pipeline=pipe)
            pipe.delete(self.job.key)
            pipe.execute()


def one_beat(connection: Any, name: str) -> None:
    register_worker(connection, asdict(beat_of(name)), 6)


@pytest.fixture(params=["memory", "redis"])
def sides(request: pytest.FixtureRequest) -> tuple[RqQueue, Worker]:
    if request.param == "memory":
        queue = MemoryQueue()
        return queue, memory_worker(queue)
    redis: RqQueue = request.getfixturevalue("rq_queue")
    side = RqSide(redis)
    return redis, Worker(side.take, side.beat, side.finish)


@pytest.fixture
def queue(sides: tuple[RqQueue, Worker]) -> RqQueue:
    return sides[0]


@pytest.fixture
def worker(sides: tuple[RqQueue, Worker]) -> Worker:
    return sides[1]


@pytest.fixture
def busy(queue: RqQueue, worker: Worker) -> Worker:
    queue.enqueue([task()], Priority.BULK)
    worker.take()
    return worker


def test_tasks_come_out_as_they_went_in(queue: RqQueue, worker: Worker) -> None:
    assert queue.enqueue([task(), task("b")], Priority.BULK) == 2
    assert queue.waiting_tasks() == {"a", "b"}
    assert queue.depths()[Priority.BULK, Stage.SYNTHESIZE] == 2
    assert worker.take() == task()
    worker.finish()
    assert worker.take() == task("b")


def test_interactive_tasks_go_before_bulk_but_do_not_starve_it(queue: RqQueue, worker: Worker) -> None:
    queue.enqueue([task(f"bulk{i}") for i in range(20)], Priority.BULK)
    queue.enqueue([task(f"urgent{i}") for i in range(20)], Priority.INTERACTIVE)
    taken = []
    for _ in range(3 * BULK_EVERY):
        found = worker.take()
        assert found is not None
        taken.append(found.task_id.rstrip("0123456789"))
        worker.finish()
    assert taken == 3 * [*["urgent"] * (BULK_EVERY - 1), "bulk"]


def test_a_waiting_task_is_not_queued_twice(queue: RqQueue, worker: Worker) -> None:
    queue.enqueue([task()], Priority.BULK)
    assert queue.enqueue([task()], Priority.BULK) == 0
    assert worker.take() is not None
    assert queue.enqueue([task()], Priority.BULK) == 0, "it is running"
    assert worker.take() is None
    assert queue.enqueue([task(attempt=2)], Priority.BULK) == 1, "another attempt is another entry"


def test_a_lease_says_who_holds_which_attempt_of_what(queue: RqQueue, worker: Worker) -> None:
    queue.enqueue([task(attempt=2)], Priority.BULK)
    worker.take()
    (lease,) = queue.leases()
    assert (lease.task_id, lease.attempt) == ("a", 2)
    assert queue.lease_holder(lease) == ("w", task(attempt=2))
    assert queue.waiting_tasks() == set()
    worker.finish()
    assert queue.leases() == []


def test_a_lease_changes_with_each_beat_until_it_is_released(queue: RqQueue, busy: Worker) -> None:
    first = queue.leases()[0].beat
    assert queue.leases()[0].beat == first
    assert busy.beat() is None
    assert queue.leases()[0].beat != first
    queue.release(queue.leases()[0])
    assert queue.leases() == []
    assert busy.beat() is StopReason.LEASE_LOST
    assert queue.leases() == [], "a late sign of life does not bring the lease back"


def test_a_discarded_task_never_starts(queue: RqQueue, worker: Worker) -> None:
    queue.enqueue([task(), task("b")], Priority.BULK)
    queue.discard(["a"])
    assert queue.waiting_tasks() == {"b"}
    assert worker.take() == task("b")


def test_a_discarded_running_task_stops_unless_queued_again(queue: RqQueue, busy: Worker) -> None:
    queue.discard(["a"])
    assert busy.beat() is StopReason.CANCELLED
    queue.enqueue([task(attempt=2)], Priority.BULK)
    busy.take()
    assert busy.beat() is None


def test_events_come_once_in_order_and_again_if_not_acknowledged(queue: RqQueue) -> None:
    for name in "abc":
        queue.publish(Event(kind=EventKind.STARTED, at=timestamp(), task_id=name))
    first = queue.consume(limit=2, wait_s=0)
    assert [event.task_id for _, event in first] == ["a", "b"]
    queue.acknowledge([event_id for event_id, _ in first[:1]])
    assert [event.task_id for _, event in queue.consume(limit=9, wait_s=0)] == ["c"]
    assert queue.consume(limit=9, wait_s=0) == []
    if isinstance(queue, MemoryQueue):
        queue.restart_consumer()
    restarted = queue if isinstance(queue, MemoryQueue) else RqQueue(queue.connection)
    assert [event.task_id for _, event in restarted.consume(limit=9, wait_s=0)] == ["b", "c"]


def test_a_part_is_there_as_long_as_it_says_so(queue: RqQueue) -> None:
    assert not queue.is_announced("controller")
    queue.announce("controller", 600)
    queue.announce("brief", 0.05)
    until(lambda: not queue.is_announced("brief"), "its time is over")
    assert queue.is_announced("controller")


def test_one_leads_until_it_is_silent_or_resigns(queue: RqQueue) -> None:
    assert queue.renew_leadership("a", 600)
    assert not queue.renew_leadership("b", 600)
    assert queue.renew_leadership("a", 600), "who leads may go on"
    queue.resign("b")
    assert not queue.renew_leadership("b", 600), "only its holder gives it back"
    queue.resign("a")
    assert queue.renew_leadership("b", 0.05)
    until(lambda: queue.renew_leadership("a", 600), "the lease of b is over")
    assert not queue.renew_leadership("b", 600)


def test_a_controller_of_graspd_0_2_holds_the_same_lease(rq_queue: RqQueue) -> None:
    rq_queue.connection.set(LEAD, "a keeper of 0.2", px=600_000)
    assert not rq_queue.renew_leadership("a", 600)
    rq_queue.connection.delete(LEAD)
    assert rq_queue.renew_leadership("a", 600)
    assert rq_queue.connection.get(LEAD) == b"a" and rq_queue.connection.pttl(LEAD) > 0, "as it would write it"


@pytest.mark.parametrize("forge", [lambda redis: redis.set(LEAD, "for ever"), lambda redis: redis.rpush(LEAD, "x")])
def test_a_lease_that_is_none_keeps_nobody_from_leading(rq_queue: RqQueue, forge: Callable[[Any], None]) -> None:
    forge(rq_queue.connection)
    assert not rq_queue.renew_leadership("a", 600)
    assert rq_queue.renew_leadership("a", 600)


@pytest.mark.parametrize(
    ("command", "ask"), [("smembers", RqQueue.waiting_tasks), ("set", lambda queue: queue.renew_leadership("a", 600))]
)
def test_what_redis_forbids_is_told(rq_queue: RqQueue, redis_server: str, command: str, ask: Any) -> None:
    rights = ["+@all", f"-{command}"]
    rq_queue.connection.acl_setuser("limited", enabled=True, nopass=True, keys=["*"], commands=rights)
    queue = RqQueue(connect(redis_server.replace("://", "://limited:x@")))
    with closing(queue), pytest.raises(QueueUnavailable, match="permissions"):
        ask(queue)


def test_sums_add_up_and_each_name_has_its_own(queue: RqQueue) -> None:
    queue.add_to_counters({"a": 1.5, "b": 2.0})
    queue.add_to_counters({"a": 1.0})
    assert queue.counter_sums() == {"a": 2.5, "b": 2.0}


def test_what_waits_is_told_by_lane_and_stage(queue: RqQueue) -> None:
    queue.enqueue([task("x"), task("y"), task("z", stage=Stage.RENDER)], Priority.BULK)
    check = IngestMessage(schema_=1, task_id="i", kind="hand", name="h", digest="0" * 32)
    queue.enqueue([check], Priority.INTERACTIVE)
    shown = queue.status(lease_s=6.0)
    assert {place: depth for place, depth in shown.depth.items() if depth} == {
        (Priority.BULK, Stage.SYNTHESIZE): 2,
        (Priority.BULK, Stage.RENDER): 1,
        (Priority.INTERACTIVE, Stage.INGEST): 1,
    }
    assert shown.depth == queue.depths()
    assert not any(shown.running.values())


def test_a_worker_is_listed_while_it_gives_signs_of_life(rq_queue: RqQueue, redis_server: str) -> None:
    heart = Heartbeat(redis_server, beat_of("alive", stages=(Stage.SYNTHESIZE,)), lease_s=6)
    heart.start()
    try:
        until(rq_queue.workers, "its first sign of life")
        (found,) = rq_queue.workers()
        assert (found.name, found.stages) == ("alive", (Stage.SYNTHESIZE,))
    finally:
        heart.stop()
    assert rq_queue.workers() == []


def test_the_stream_of_events_is_bounded(rq_queue: RqQueue, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.service.queue.rq_queue.EVENTS_KEPT", 200)
    for _ in range(1000):
        rq_queue.publish(Event(kind=EventKind.STARTED, at=timestamp()))
    # Redis trims whole nodes of the stream, of 100 entries each.
    assert rq_queue.connection.xlen("graspd:events") <= 300


def test_redis_keeps_nothing_of_a_finished_task(rq_queue: RqQueue) -> None:
    side = RqSide(rq_queue)
    before = {key for key in rq_queue.connection.keys("*") if b"queues" not in key}
    rq_queue.enqueue([task()], Priority.BULK)
    side.take()
    side.finish()
    assert {key for key in rq_queue.connection.keys("*") if b"queues" not in key} == before


def test_a_killed_worker_leaves_nothing_in_redis(rq_queue: RqQueue) -> None:
    served = queue_names(tuple(Stage))
    worker = SimpleWorker(served, connection=rq_queue.connection, name="dead", serializer=JSONSerializer)
    worker.register_birth()
    one_beat(rq_queue.connection, "dead")
    rq_queue.remove_stale_keys()
    assert [beat.name for beat in rq_queue.workers()] == ["dead"], "it lives"
    rq_queue.connection.delete(worker_key("dead"))  # as its time to live does
    rq_queue.remove_stale_keys()
    assert [key for key in rq_queue.connection.keys("*") if b"worker" in key] == []


def test_a_lost_consumer_group_is_made_again(rq_queue: RqQueue) -> None:
    assert rq_queue.consume(limit=1, wait_s=0) == []
    rq_queue.connection.flushdb()
    rq_queue.publish(Event(kind=EventKind.STARTED, at=timestamp(), task_id="a"))
    assert [event.task_id for _, event in rq_queue.consume(limit=9, wait_s=0)] == ["a"]


BULK = queue_name(Priority.BULK, Stage.SYNTHESIZE)


def cost_of_a_sweep(queue: RqQueue) -> int:
    before = queue.connection.info("stats")["total_commands_processed"]
    queue.leases()
    return int(queue.connection.info("stats")["total_commands_processed"] - before)


def test_all_leases_are_read_in_one_round_trip(rq_queue: RqQueue) -> None:
    rq_queue.connection.zadd(lease_registry_key(BULK), {"a-1:x": 1.0})
    few = cost_of_a_sweep(rq_queue)
    rq_queue.connection.zadd(lease_registry_key(BULK), {f"{number}-1:x": 1.0 for number in range(500)})
    assert len(rq_queue.leases()) == 501
    assert cost_of_a_sweep(rq_queue) == few


def test_tasks_are_added_together_and_none_twice(rq_queue: RqQueue) -> None:
    tasks = [task(f"{number:032x}") for number in range(700)]
    assert rq_queue.enqueue(tasks[:10], Priority.BULK) == 10
    assert rq_queue.enqueue(tasks, Priority.BULK) == 690
    assert rq_queue.waiting_tasks() == {task.task_id for task in tasks}
    assert sum(rq_queue.depths().values()) == 700
    rq_queue.connection.delete(list_key(BULK))
    assert rq_queue.enqueue(tasks, Priority.BULK) == 0, "what the queue knows is not added again"
    assert rq_queue.enqueue(tasks, Priority.BULK, again=True) == 700


def test_unreadable_events_stay_nobodys_work(rq_queue: RqQueue) -> None:
    rq_queue.connection.xadd("graspd:events", {"e": "rubbish"})
    rq_queue.publish(Event(kind=EventKind.STARTED, at=timestamp(), task_id="a"))
    ((event_id, _),) = rq_queue.consume(limit=9, wait_s=0)
    rq_queue.acknowledge([event_id])
    assert rq_queue.connection.xpending("graspd:events", "keeper")["pending"] == 0


def test_everything_in_redis_of_no_fixed_number_has_an_end(rq_queue: RqQueue) -> None:
    rq_queue.enqueue([task()], Priority.BULK)
    rq_queue.discard(["0" * 32])
    rq_queue.announce("controller", 5)
    rq_queue.renew_leadership("a", 5)
    rq_queue.publish(Event(kind=EventKind.STARTED, at=timestamp(), task_id="a"))
    rq_queue.publish(Event(kind=EventKind.FINISHED, at=timestamp(), task_id="a"))
    fixed = ("rq:queue", "rq:job", "rq:unique", EVENTS, "graspd:workers", "graspd:tally")
    without_end = [key.decode() for key in rq_queue.connection.keys("*") if rq_queue.connection.ttl(key) < 0]
    assert [key for key in without_end if not key.startswith(fixed)] == []
