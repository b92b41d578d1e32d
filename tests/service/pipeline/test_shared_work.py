"""Two keepers on the in-memory parts: each looks after its own jobs, and the first one after what is of none."""

from __future__ import annotations

import pytest

from service.index.rebuild import differences
from service.model.errors import IndexUnavailable
from service.model.keeper_shards import KeeperShards, shard_of
from service.model.states import Lane, State
from service.model.turns import Turns
from service.pipeline import job_actions
from service.pipeline.backends import Parts
from service.pipeline.keeper import Keeper
from service.pipeline.reaper import LOST_AFTER_S
from service.queue.port import Event
from tests.fakes import fake_stages, request
from tests.memory_queue import MemoryQueue
from worker.process.runner import Runner
from worker.stages.context import TaskContext


class Clock:
    """Time that passes when told to."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


class Two:
    """Keepers of the two shards, and one worker, all moved step by step."""

    def __init__(self, parts: Parts) -> None:
        assert isinstance(parts.queue, MemoryQueue)
        self.parts, self.queue, self.clock = parts, parts.queue, Clock()
        self.queue.take_share("one that is told so", 600, number=2)
        self.first, self.second = (
            Keeper(parts, KeeperShards(2, frozenset({shard})), clock=self.clock) for shard in (0, 1)
        )
        self.first.round()
        self.second.round()

    def submit(self, shard: int, *, batches: int = 1) -> str:
        """A job of a shard."""
        for seed in range(1000):
            found = job_actions.prepare(self.parts, request(grasps=32 * batches, seed=seed))
            if shard_of(found.id, 2) == shard:
                return job_actions.enter(self.parts, found)[0].id
        raise AssertionError("ids of jobs are no hashes")

    def pass_time(self, keeper: Keeper, seconds: float) -> None:
        for _ in range(round(seconds)):
            self.clock.now += 1.0
            keeper.round()

    def do(self) -> list[Event]:
        """What a worker does with all that waits; what it says while it works, and at the end of each task."""
        ends = []
        runner = Runner(fake_stages(), worker="w", publish=self.queue.publish)
        while (delivery := self.queue.take("w")) is not None:
            raw = delivery.message.model_dump(mode="json", by_alias=True)
            if (outcome := runner.run(raw, TaskContext(self.parts.store))) is not None:
                ends.append(outcome)
            self.queue.finish(delivery)
        return ends

    def state(self, job: str) -> State:
        return self.parts.index.jobs.get(job).state


@pytest.fixture
def two(parts: Parts) -> Two:
    return Two(parts)


def test_each_keeper_takes_up_the_events_of_its_own_jobs(two: Two) -> None:
    jobs = [two.submit(0, batches=3), two.submit(1, batches=3)]
    two.queue.publish(*two.do())
    two.pass_time(two.second, 2)
    assert [two.state(job) for job in jobs] == [State.QUEUED, State.SUCCEEDED]
    two.pass_time(two.first, 2)
    assert [two.state(job) for job in jobs] == [State.SUCCEEDED, State.SUCCEEDED]
    assert differences(two.parts.index, two.parts.store) == []


def test_events_of_a_worker_of_an_earlier_version_are_handed_on(two: Two) -> None:
    job = two.submit(1)
    two.queue.hand_on([(0, event) for event in two.do()])
    two.pass_time(two.second, 1)
    assert two.state(job) is not State.SUCCEEDED, "it lies in the only stream that an earlier version knows"
    two.pass_time(two.first, 1)
    assert two.state(job) is not State.SUCCEEDED, "the first keeper leaves it to the second"
    two.pass_time(two.second, 1)
    assert two.state(job) is State.SUCCEEDED


def test_what_lies_in_a_stream_of_more_shards_than_there_are_is_taken_up(two: Two) -> None:
    jobs = [two.submit(0), two.submit(1)]
    two.queue.hand_on([(5, event) for event in two.do()])
    two.pass_time(two.first, 4)
    two.pass_time(two.second, 1)
    assert [two.state(job) for job in jobs] == [State.SUCCEEDED, State.SUCCEEDED]


def test_a_task_of_a_lost_worker_is_taken_from_it_by_the_keeper_of_its_job(two: Two) -> None:
    two.submit(1)
    assert two.queue.take("w") is not None
    two.pass_time(two.first, 3 * two.parts.settings.lease_s)
    assert len(two.queue.leases()) == 1
    two.pass_time(two.second, two.parts.settings.lease_s + 2)
    assert two.queue.leases() == []
    again = two.queue.take("w")
    assert again is not None and again.message.attempt == 2


def test_a_task_that_the_queue_lost_is_queued_again_by_the_keeper_of_its_job(two: Two) -> None:
    two.submit(1)
    assert two.queue.waiting()
    for waiting in two.queue._lanes.values():
        waiting.clear()
    two.pass_time(two.first, LOST_AFTER_S + 3)
    assert not two.queue.waiting()
    two.pass_time(two.second, LOST_AFTER_S + 3)
    assert two.queue.waiting()


def test_the_jobs_of_a_keeper_are_those_whose_ids_fall_into_its_shards(two: Two) -> None:
    for shard in (0, 1, 0, 1):
        two.submit(shard, batches=2)
    feed = two.parts.index.feed
    everything, _ = feed.believed_queued()
    assert everything
    for number in (2, 3, 7):
        some = [feed.believed_queued(KeeperShards(number, frozenset({shard})))[0] for shard in range(number)]
        assert set().union(*some) == everything and sum(map(len, some)) == len(everything)
        for shard, found in enumerate(some):
            assert all(shard_of(two.parts.index.jobs.task(task).job_id, number) == shard for task in found)


def test_together_two_keepers_queue_what_one_would(two: Two) -> None:
    small = two.parts.settings.model_copy(update={"queue_window": 1})
    crowded = Parts(small, two.parts.store, two.parts.index, two.parts.queue)
    for seed in range(9):
        job_actions.submit(crowded, request(grasps=32 * 20, seed=seed), lane=Lane.BULK)
    feed, now = two.parts.index.feed, 2e9
    alone = feed.ready_tasks(Lane.BULK, Turns(), now=now, limit=30)
    shared = [
        feed.ready_tasks(Lane.BULK, Turns(), now=now, limit=30, shards=KeeperShards(2, frozenset({shard})))
        for shard in (0, 1)
    ]
    assert all(shared), "both have some"
    assert sorted(task.task.id for some in shared for task in some) == sorted(task.task.id for task in alone)


def test_until_the_first_keeper_has_made_the_index_whole_the_others_wait(two: Two) -> None:
    fresh = Keeper(two.parts, KeeperShards(2, frozenset({1})), clock=two.clock)
    with two.parts.index.database.writing() as connection:
        connection.exec_driver_sql("DELETE FROM notes")
    with pytest.raises(IndexUnavailable, match="first shard"):
        fresh.round()
    two.first.round()
    fresh.round()
