"""From jobs to tasks, and from facts to states."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.service.model.clock import timestamp
from graspd.service.model.digests import job_id
from graspd.service.model.domain import JobRequest
from graspd.service.model.planning import (
    MAX_BACKOFF_S,
    TaskFacts,
    backoff,
    batch_ready,
    batch_states,
    job_state,
    message_of,
    plan,
    priority_of,
)
from graspd.service.model.records import JobRecord
from graspd.service.model.states import Priority, Stage, State
from tests.fakes import request

HAND, OBJECT = "a" * 32, "b" * 32


def record(wanted: JobRequest) -> JobRecord:
    return JobRecord(
        id=job_id(wanted, HAND, OBJECT),
        request=wanted,
        hand_digest=HAND,
        object_digest=OBJECT,
        priority=Priority.BULK,
        created=timestamp(),
    )


def test_a_job_is_cut_into_batches_of_32_and_the_last_is_smaller() -> None:
    tasks = list(plan(record(request(grasps=70))))
    assert [task.count for task in tasks] == [32, 32, 6]
    assert [task.batch for task in tasks] == [0, 1, 2]


@pytest.mark.parametrize(
    ("changes", "stages"),
    [
        ({}, [Stage.SYNTHESIZE]),
        ({"scenes": 2}, [Stage.SYNTHESIZE, Stage.SCENE]),
        ({"scenes": 2, "views": 3}, [Stage.SYNTHESIZE, Stage.SCENE, Stage.RENDER]),
    ],
)
def test_only_what_was_asked_for_is_planned(changes: dict[str, int], stages: list[Stage]) -> None:
    assert [task.stage for task in plan(record(request(**changes)))] == stages


def test_each_stage_reads_what_the_stage_before_writes() -> None:
    base, scene, views = plan(record(request(scenes=2, views=3)))
    assert base.inputs == ()
    assert scene.inputs == (base.output,)
    assert views.inputs == (scene.output,)


def test_more_views_are_other_pictures_of_the_same_grasps_and_scenes() -> None:
    few, many = (list(plan(record(request(scenes=2, views=views)))) for views in (3, 4))
    assert [task.output for task in few[:2]] == [task.output for task in many[:2]]
    assert few[2].output != many[2].output
    assert {task.id for task in few}.isdisjoint({task.id for task in many})


@given(st.integers(1, 2000), st.integers(0, 2), st.integers(0, 2))
def test_a_plan_makes_each_grasp_once_and_names_nothing_twice(grasps: int, scenes: int, views: int) -> None:
    tasks = list(plan(record(request(grasps=grasps, scenes=scenes, views=views if scenes else 0))))
    assert sum(task.count for task in tasks if task.stage is Stage.SYNTHESIZE) == grasps
    assert len({task.id for task in tasks}) == len({task.output for task in tasks}) == len(tasks)


def test_a_small_job_is_interactive_and_a_large_one_is_bulk() -> None:
    assert priority_of(request(grasps=32)) is Priority.INTERACTIVE
    assert priority_of(request(grasps=100_000)) is Priority.BULK


def test_a_message_is_enough_to_do_the_task() -> None:
    job = record(request(scenes=1))
    _, scene = plan(job)
    message = message_of(job, scene, attempt=2, max_attempt=3)
    assert (message.task_id, message.inputs, message.output) == (scene.id, scene.inputs, scene.output)
    assert (message.attempt, message.max_attempt) == (2, 3)


def facts(*stages: Stage, **of_first: object) -> list[TaskFacts]:
    return [TaskFacts(stages[0], **of_first), *(TaskFacts(stage) for stage in stages[1:])]  # type: ignore[arg-type]


CHAIN = (Stage.SYNTHESIZE, Stage.SCENE, Stage.RENDER)


def test_only_the_first_stage_may_start_at_first() -> None:
    states = batch_states(facts(*CHAIN), job_cancelled=False)
    assert states == [State.QUEUED] * 3
    assert batch_ready(states) == [True, False, False]


def test_a_finished_stage_frees_the_next_one() -> None:
    states = batch_states(facts(*CHAIN, done=True), job_cancelled=False)
    assert states == [State.SUCCEEDED, State.QUEUED, State.QUEUED]
    assert batch_ready(states) == [False, True, False]


def test_what_follows_a_failed_task_is_cancelled_not_left_waiting() -> None:
    states = batch_states(facts(*CHAIN, last_attempt=3, exhausted=True), job_cancelled=False)
    assert states == [State.FAILED, State.CANCELLED, State.CANCELLED]
    assert batch_ready(states) == [False] * 3


def test_a_retried_task_waits_again_and_so_does_what_follows() -> None:
    states = batch_states(facts(*CHAIN, last_attempt=3, exhausted=True, retried_upto=3), job_cancelled=False)
    assert states == [State.QUEUED] * 3


def test_a_failure_after_the_retry_counts() -> None:
    chain = facts(*CHAIN, last_attempt=6, exhausted=True, retried_upto=3)
    assert batch_states(chain, job_cancelled=False)[0] is State.FAILED


def test_a_cancelled_job_keeps_what_is_done() -> None:
    states = batch_states(facts(*CHAIN, done=True), job_cancelled=True)
    assert states == [State.SUCCEEDED, State.CANCELLED, State.CANCELLED]


def test_a_shard_that_turns_up_after_a_failure_counts_as_success() -> None:
    states = batch_states(facts(*CHAIN, done=True, last_attempt=3, exhausted=True), job_cancelled=False)
    assert states[0] is State.SUCCEEDED


@pytest.mark.parametrize(
    ("tasks", "state"),
    [
        ({"queued"}, "queued"),
        ({"queued", "running"}, "running"),
        ({"queued", "succeeded"}, "running"),
        ({"queued", "failed", "cancelled"}, "running"),
        ({"succeeded"}, "succeeded"),
        ({"succeeded", "failed", "cancelled"}, "failed"),
        ({"succeeded", "cancelled"}, "cancelled"),
    ],
)
def test_the_state_of_a_job_follows_from_its_tasks(tasks: set[str], state: str) -> None:
    assert job_state(State(task) for task in tasks) == state


def test_the_wait_doubles_up_to_a_bound() -> None:
    assert [backoff(2.0, failures) for failures in (1, 2, 3)] == [2.0, 4.0, 8.0]
    assert backoff(2.0, 1000) == MAX_BACKOFF_S
