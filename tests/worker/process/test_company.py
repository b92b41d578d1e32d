"""A worker that takes several tasks of one pair: each ends, fails, is cancelled and handed back by itself."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rq.serializers import JSONSerializer

from service.model.clock import timestamp
from service.model.messages import TaskMessage
from service.model.planning import message_of, plan
from service.model.records import JobRecord
from service.model.states import Lane, Stage
from service.queue.allowed import TASK_FUNCTION, AllowedJob
from service.queue.lists import queue_name
from service.queue.port import READS_PACKS, EventKind
from service.queue.rq_queue import WORKERS, RqQueue
from service.queue.taking import take_alike
from service.settings import Settings
from service.store.manifests import shard_exists
from service.store.packs import pack_at
from service.store.records import task_attempts
from service.store.store import open_store
from tests.fakes import alike_batches, fake_synthesize, request
from tests.waiting import PATIENCE_S
from worker.process.company import Company
from worker.process.main import run_worker
from worker.stages.alike import alike
from worker.stages.context import TaskContext

SYNTHESIZE = queue_name(Lane.BULK, Stage.SYNTHESIZE)


def batches(count: int, *, obj: str = "b", attempt: int = 1, **changes: Any) -> list[TaskMessage]:
    """The tasks of a job of so many batches on an object."""
    digests = {"hand_digest": "a" * 32, "object_digest": obj * 32}
    wanted = request(grasps=32 * count, **changes)
    job = JobRecord(id=obj * 32, request=wanted, lane=Lane.BULK, created=timestamp(), **digests)
    tasks = [task for task in plan(job) if task.stage is Stage.SYNTHESIZE]
    return [message_of(job, task, attempt=attempt, max_attempt=3) for task in tasks]


@pytest.fixture
def work(rq_queue: RqQueue, redis_server: str, tmp_path: Path) -> Callable[..., dict[str, list[EventKind]]]:
    """Lets a worker do what waits; gives the events of each task."""

    def run(stage: Any, *, join: str = "4", ended_well: bool = True, shard_pack: int = 8) -> dict[str, list[EventKind]]:
        settings = Settings(
            redis_url=redis_server, data_dir=tmp_path, device="cpu", join=join, shard_pack=shard_pack,
        )  # type: ignore[arg-type]  # fmt: skip
        assert run_worker(settings, table={Stage.SYNTHESIZE: stage}, alike=alike_batches, burst=True) is ended_well
        told: dict[str, list[EventKind]] = {}
        for _, event in rq_queue.tail("0", limit=1000, wait_s=0):
            if event.task_id:
                told.setdefault(event.task_id, []).append(event.kind)
        assert rq_queue.leases() == []
        assert not rq_queue.connection.keys("rq:execution*"), "no lease is left"
        return told

    return run


class Meetings:
    """A stage that does tasks in their meeting; knows how many were done at once."""

    def __init__(self, special: Callable[[TaskMessage, TaskContext], Any] | None = None) -> None:
        self.together: list[int] = []
        self._special = special

    def __call__(self, message: TaskMessage, context: TaskContext) -> Any:
        def all_of_them(items: Any) -> Any:
            self.together.append(len(items))
            return items

        if context.meeting is None:
            self.together.append(1)
        else:
            context.meeting.ask("same", message.batch, all_of_them, size=1, cancelled=context.cancelled)
        if self._special is not None and (made := self._special(message, context)) is not None:
            return made
        return fake_synthesize(message, context)


def test_tasks_of_one_pair_are_done_together_and_each_leaves_its_shard(
    rq_queue: RqQueue, work: Callable[..., Any], tmp_path: Path
) -> None:
    same, other = batches(5), batches(2, obj="d")
    rq_queue.enqueue([same[0], other[0], *same[1:], other[1]], Lane.BULK)
    stage = Meetings()
    told = work(stage)
    assert stage.together == [5, 2]
    assert told == {task.task_id: [EventKind.STARTED, EventKind.FINISHED] for task in (*same, *other)}
    store = open_store((tmp_path / "store").as_uri())
    assert all(shard_exists(store, Stage.SYNTHESIZE, task.output) for task in (*same, *other))
    assert not rq_queue.connection.keys("rq:job:*")


def test_shards_of_tasks_that_end_together_are_one_object_and_one_event(
    rq_queue: RqQueue, work: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("worker.process.surroundings.WAIT_S", 600.0)
    tasks = batches(5)

    def fail_one(message: TaskMessage, context: TaskContext) -> Any:
        if message.batch == 1:
            raise ValueError("no grasp")
        return None

    rq_queue.announce(READS_PACKS, 600)
    rq_queue.enqueue(tasks, Lane.BULK)
    told = work(Meetings(fail_one), shard_pack=2)
    failed = tasks.pop(1)
    assert told[failed.task_id] == [EventKind.STARTED, EventKind.FAILED]
    assert [told[task.task_id] for task in tasks] == [[EventKind.STARTED]] * 4
    (end,) = [event for _, event in rq_queue.tail("0", limit=99, wait_s=0) if event.kind is EventKind.PACKED]
    store = open_store((tmp_path / "store").as_uri())
    assert end.job_id == failed.job_id, "it goes to the keeper of their job"
    found = [shard.id for shard in pack_at(store, end.pack).shards]
    assert sorted(found) == sorted(task.output for task in tasks)
    assert list(store.list("shards")) == []
    assert rq_queue.reports() == {}


def test_where_no_keeper_reads_packs_each_shard_is_put_by_itself(
    rq_queue: RqQueue, work: Callable[..., Any], tmp_path: Path
) -> None:
    tasks = batches(4)
    rq_queue.enqueue(tasks, Lane.BULK)
    told = work(Meetings(), shard_pack=2)
    assert told == {task.task_id: [EventKind.STARTED, EventKind.FINISHED] for task in tasks}
    store = open_store((tmp_path / "store").as_uri())
    assert all(shard_exists(store, Stage.SYNTHESIZE, task.output) for task in tasks)


@pytest.mark.parametrize("join", ["1", "auto"])
def test_on_a_cpu_tasks_are_done_one_by_one_unless_told_otherwise(
    rq_queue: RqQueue, work: Callable[..., Any], join: str
) -> None:
    rq_queue.enqueue(batches(3), Lane.BULK)
    stage = Meetings()
    work(stage, join=join)
    assert stage.together == [1, 1, 1]


def test_two_launches_worth_of_tasks_are_taken_at_the_most(rq_queue: RqQueue, work: Callable[..., Any]) -> None:
    rq_queue.enqueue(batches(7), Lane.BULK)
    most: list[int] = []

    def note(message: TaskMessage, context: TaskContext) -> None:
        most.append(len(rq_queue.leases()))

    work(Meetings(note), join="2")
    assert max(most) == 4


def test_one_that_fails_is_recorded_and_the_others_are_done(
    rq_queue: RqQueue, work: Callable[..., Any], tmp_path: Path
) -> None:
    tasks = batches(3)

    def fail(message: TaskMessage, context: TaskContext) -> None:
        if message.batch == 1:
            raise ValueError("no way")

    rq_queue.enqueue(tasks, Lane.BULK)
    told = work(Meetings(fail))
    assert [told[task.task_id][-1] for task in tasks] == [EventKind.FINISHED, EventKind.FAILED, EventKind.FINISHED]
    store = open_store((tmp_path / "store").as_uri())
    assert [len(task_attempts(store, task.task_id)) for task in tasks] == [0, 1, 0]


def test_one_that_is_cancelled_stops_while_the_others_go_on(rq_queue: RqQueue, work: Callable[..., Any]) -> None:
    tasks, stopped = batches(3), threading.Event()

    def wait(message: TaskMessage, context: TaskContext) -> None:
        if message.batch == 1:
            rq_queue.discard([message.task_id])
            while not context.cancelled():
                stopped.wait(0.01)
            stopped.set()
            context.check()
        assert stopped.wait(PATIENCE_S), "the others are still at work when it stops"

    rq_queue.enqueue(tasks, Lane.BULK)
    told = work(Meetings(wait))
    assert [told[task.task_id][-1] for task in tasks] == [EventKind.FINISHED, EventKind.CANCELLED, EventKind.FINISHED]


def test_a_worker_told_to_stop_hands_all_of_them_back(
    rq_queue: RqQueue, work: Callable[..., Any], tmp_path: Path
) -> None:
    tasks = batches(3)

    def stop(message: TaskMessage, context: TaskContext) -> None:
        if message.batch == 1:
            os.kill(os.getpid(), signal.SIGTERM)
        while True:
            threading.Event().wait(0.01)
            context.check()

    rq_queue.enqueue(tasks, Lane.BULK)
    told = work(Meetings(stop))
    assert [told[task.task_id][-1] for task in tasks] == [EventKind.RETURNED] * 3
    store = open_store((tmp_path / "store").as_uri())
    assert all(task_attempts(store, task.task_id) == [] for task in tasks)


def test_one_whose_lease_was_taken_says_nothing_and_leaves_nothing(rq_queue: RqQueue, work: Callable[..., Any]) -> None:
    tasks = batches(3)

    def lose(message: TaskMessage, context: TaskContext) -> None:
        if message.batch == 1:
            (lease,) = [one for one in rq_queue.leases() if one.task_id == message.task_id]
            rq_queue.release(lease)

    rq_queue.enqueue(tasks, Lane.BULK)
    told = work(Meetings(lose))
    assert told[tasks[0].task_id][-1] == told[tasks[2].task_id][-1] == EventKind.FINISHED
    assert not rq_queue.connection.keys("rq:job:*")


def forged(queue: RqQueue, job: str, function: str, arguments: Any) -> None:
    made = AllowedJob.create(
        function, args=arguments, id=job, connection=queue.connection, serializer=JSONSerializer, origin=SYNTHESIZE
    )
    made.save()
    queue.connection.rpush(f"rq:queue:{SYNTHESIZE}", job)


def test_forged_entries_are_left_where_they_are(rq_queue: RqQueue) -> None:
    good = batches(2)
    raw = [message.model_dump(mode="json", by_alias=True) for message in batches(4)]
    forged(rq_queue, f"{good[0].task_id}-7", "os.system", ("true",))
    forged(rq_queue, "another-1", TASK_FUNCTION, (raw[2],))
    forged(rq_queue, "nothing-1", TASK_FUNCTION, ())
    rq_queue.connection.rpush(f"rq:queue:{SYNTHESIZE}", b"\xff\xfe", "gone-1")
    rq_queue.enqueue(good, Lane.BULK)
    forged(rq_queue, "list-1", TASK_FUNCTION, ([1, 2],))
    rq_queue.connection.set("rq:job:text-1", "no hash")
    rq_queue.connection.rpush(f"rq:queue:{SYNTHESIZE}", "text-1", f"{good[0].task_id}-1")
    waiting = rq_queue.connection.llen(f"rq:queue:{SYNTHESIZE}")
    found = take_alike(rq_queue.connection, SYNTHESIZE, lambda message: True, lambda there: there)
    assert [job.id for job in found] == [f"{message.task_id}-1" for message in good]
    assert rq_queue.connection.llen(f"rq:queue:{SYNTHESIZE}") == waiting - 2


def test_what_another_worker_took_meanwhile_is_not_taken(rq_queue: RqQueue) -> None:
    tasks = batches(3)
    rq_queue.enqueue(tasks, Lane.BULK)

    def first_is_taken(there: int) -> int:
        rq_queue.connection.lpop(f"rq:queue:{SYNTHESIZE}")
        return there

    found = take_alike(rq_queue.connection, SYNTHESIZE, lambda message: True, first_is_taken)
    assert [job.id for job in found] == [f"{message.task_id}-1" for message in tasks[1:]]


def test_a_list_that_is_none_gives_nothing(rq_queue: RqQueue) -> None:
    rq_queue.connection.set(f"rq:queue:{SYNTHESIZE}", "forged")
    assert take_alike(rq_queue.connection, SYNTHESIZE, lambda message: True, lambda there: there) == []


def test_workers_share_what_waits(rq_queue: RqQueue) -> None:
    tasks = batches(8)
    rq_queue.enqueue(tasks, Lane.BULK)
    rq_queue.connection.sadd(WORKERS, "one", "two", "three")
    popped = rq_queue.connection.lpop(f"rq:queue:{SYNTHESIZE}").decode()
    job = AllowedJob.fetch(popped, connection=rq_queue.connection, serializer=JSONSerializer)
    assert len(Company(rq_queue.connection, lambda: 32, alike_batches).take(job, SYNTHESIZE)) == 2


def test_only_first_attempts_of_one_pair_and_way_to_plan_are_alike() -> None:
    (first, second), (other,) = batches(2), batches(1, obj="d")
    assert alike(first) == alike(second) is not None
    assert alike(other) not in (None, alike(first))
    assert alike(batches(1, seed=7)[0]) == alike(first), "seeds are the batches' own"
    assert len({alike(batches(1, **more)[0]) for more in ({}, {"fidelity": "draft"}, {"scene": "table"})}) == 3
    # A task that was tried before may be one that ends its worker.
    assert alike(batches(1, attempt=2)[0]) is None
    assert alike(batches(1, method="dfc")[0]) is None
