"""From jobs to tasks, and from facts to states."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.model.clock import timestamp
from service.model.digests import job_id
from service.model.domain import JobRequest
from service.model.planning import (
    MAX_BACKOFF_S,
    TaskFacts,
    backoff,
    batch_ready,
    batch_states,
    job_state,
    lane_of,
    message_of,
    plan,
)
from service.model.records import JobRecord
from service.model.states import Lane, Stage, State
from tests.fakes import request

HAND, OBJECT = "a" * 32, "b" * 32


def record(wanted: JobRequest) -> JobRecord:
    digests = {"hand_digest": HAND, "object_digest": OBJECT}
    return JobRecord(id=job_id(wanted, HAND, OBJECT), request=wanted, lane=Lane.BULK, created=timestamp(), **digests)


def test_a_job_is_cut_into_batches_of_32_and_the_last_is_smaller() -> None:
    assert [(task.batch, task.count) for task in plan(record(request(grasps=70)))] == [(0, 32), (1, 32), (2, 6)]


def test_only_what_was_asked_for_is_planned_and_reads_what_the_stage_before_writes() -> None:
    (alone,) = plan(record(request()))
    assert (alone.stage, alone.inputs) == (Stage.SYNTHESIZE, ())
    assert [task.stage for task in plan(record(request(scenes=2)))] == [Stage.SYNTHESIZE, Stage.SCENE]
    base, scene, views = plan(record(request(scenes=2, views=3)))
    assert [task.stage for task in (base, scene, views)] == [Stage.SYNTHESIZE, Stage.SCENE, Stage.RENDER]
    assert (base.inputs, scene.inputs, views.inputs) == ((), (base.output,), (scene.output,))


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
    assert lane_of(request(grasps=32)) is Lane.INTERACTIVE
    assert lane_of(request(grasps=100_000)) is Lane.BULK


def test_a_message_is_enough_to_do_the_task() -> None:
    job = record(request(scenes=1))
    _, scene = plan(job)
    message = message_of(job, scene, attempt=2, max_attempt=3)
    assert (message.task_id, message.inputs, message.output) == (scene.id, scene.inputs, scene.output)
    assert (message.attempt, message.max_attempt) == (2, 3)


def facts(*stages: Stage, **of_first: object) -> list[TaskFacts]:
    return [TaskFacts(stages[0], **of_first), *(TaskFacts(stage) for stage in stages[1:])]  # type: ignore[arg-type]


CHAIN = (Stage.SYNTHESIZE, Stage.SCENE, Stage.RENDER)


DONE, QUEUED, FAILED, GONE = State.SUCCEEDED, State.QUEUED, State.FAILED, State.CANCELLED
OVER = {"last_attempt": 3, "exhausted": True}


@pytest.mark.parametrize(
    ("first", "cancelled", "states", "ready"),
    [
        ({}, False, [QUEUED] * 3, 0),
        ({"done": True}, False, [DONE, QUEUED, QUEUED], 1),
        (OVER, False, [FAILED, GONE, GONE], None),
        (OVER | {"retried_upto": 3}, False, [QUEUED] * 3, 0),
        (OVER | {"last_attempt": 6, "retried_upto": 3}, False, [FAILED, GONE, GONE], None),
        ({"done": True}, True, [DONE, GONE, GONE], None),
        (OVER | {"done": True}, False, [DONE, QUEUED, QUEUED], 1),
    ],
    ids=["new", "done", "failed", "retried", "failed after it", "cancelled", "a shard after a failure"],
)
def test_states_of_a_batch_follow_from_facts(
    first: dict[str, Any], cancelled: bool, states: list[State], ready: int | None
) -> None:
    found = batch_states(facts(*CHAIN, **first), job_cancelled=cancelled)
    assert found == states
    assert batch_ready(found) == [place == ready for place in range(3)]


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
