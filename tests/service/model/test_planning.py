"""From jobs to tasks, from facts to states, and what is told where fewer grasps were found than asked."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.service.model import planning
from graspd.service.model.planning import MAX_BACKOFF_S, OUTCOMES, TaskFacts, plan, shortfall, totals
from graspd.service.model.states import Priority, Stage, State
from tests.fakes import request
from tests.service.model.jobs import record

CHAIN = (Stage.SYNTHESIZE, Stage.SCENE, Stage.RENDER)
DONE, QUEUED, FAILED, GONE = State.SUCCEEDED, State.QUEUED, State.FAILED, State.CANCELLED
OVER = {"last_attempt": 3, "exhausted": True}


def test_a_job_is_cut_into_batches_of_32_and_only_what_was_asked_for_stage_by_stage() -> None:
    assert [(task.batch, task.count) for task in plan(record(request(grasps=70)))] == [(0, 32), (1, 32), (2, 6)]
    (alone,) = plan(record(request()))
    assert (alone.stage, alone.inputs) == (Stage.SYNTHESIZE, ())
    few, many = (list(plan(record(request(scenes=2, views=views)))) for views in (3, 4))
    assert [task.stage for task in few] == [*CHAIN]
    assert [task.inputs for task in few] == [(), (few[0].output,), (few[1].output,)]
    # More views are other pictures of the same grasps.
    assert [task.output for task in few[:2]] == [task.output for task in many[:2]]
    assert few[2].output != many[2].output
    assert {task.id for task in few}.isdisjoint({task.id for task in many})


@given(st.integers(1, 2000), st.integers(0, 2), st.integers(0, 2))
def test_a_plan_makes_each_grasp_once_and_names_nothing_twice(grasps: int, scenes: int, views: int) -> None:
    tasks = list(plan(record(request(grasps=grasps, scenes=scenes, views=views if scenes else 0))))
    assert sum(task.count for task in tasks if task.stage is Stage.SYNTHESIZE) == grasps
    assert len({task.id for task in tasks}) == len({task.output for task in tasks}) == len(tasks)


def test_a_small_job_is_interactive_and_a_large_one_is_bulk() -> None:
    assert planning.priority_of(request(grasps=32)) is Priority.INTERACTIVE
    assert planning.priority_of(request(grasps=100_000)) is Priority.BULK


def test_a_message_is_enough_to_do_the_task() -> None:
    job = record(request(scenes=1))
    _, scene = plan(job)
    message = planning.message_of(job, scene, attempt=2, max_attempt=3)
    assert (message.task_id, message.inputs, message.output) == (scene.id, scene.inputs, scene.output)
    assert (message.attempt, message.max_attempt) == (2, 3)


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
    chain = [TaskFacts(stage, **(first if stage is CHAIN[0] else {})) for stage in CHAIN]
    found = planning.batch_states(chain, job_cancelled=cancelled)
    assert found == states
    assert planning.batch_ready(found) == [place == ready for place in range(3)]


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
    assert planning.job_state(State(task) for task in tasks) == state


def test_the_wait_doubles_up_to_a_bound() -> None:
    assert [planning.backoff(2.0, failures) for failures in (1, 2, 3)] == [2.0, 4.0, 8.0]
    assert planning.backoff(2.0, 1000) == MAX_BACKOFF_S


def test_why_fewer_grasps_were_found_is_told_the_most_frequent_first() -> None:
    assert shortfall(8, 8, "valid", 12, 4, {"slipped": 4}) is None
    lost = totals([{"slipped": 4, "no_place": 1}, {"slipped": 1, "turned": 2, "alike": 0, "fell_apart": 3}])
    assert lost == {"no_place": 1, "turned": 2, "slipped": 5, "fell_apart": 3}
    said = str(shortfall(0, 2, "valid", 8, 4, lost))
    known = {name: f"{count} {OUTCOMES.get(name)}" for name, count in lost.items()}
    counts = f"{known['slipped']}, 3 fell apart, {known['turned']}, {known['no_place']}"
    assert said.startswith(f"found 0 of 2 valid grasps in 8 candidates: {counts}; the budget of 4 candidates")
    said = str(shortfall(1, 4, "valid", 7, 4, {"not_lifted": 6, "repeated": 9}))
    assert said.startswith("found 1 of 4 valid grasps in 16 candidates: 9 repeated attempts, 6 not lifted; the budget")


def test_a_limit_of_the_hand_stands_where_the_budget_would() -> None:
    limit = planning.limit_told("barrett", 0.6, 16, 5.66, math.inf, 100.0)
    assert limit == "barrett lifts 5.7 kg at friction 0.6 in the best of 16 grasps; 100 kg are wanted"
    assert str(shortfall(0, 4, "valid", 4, 4, {}, limit)) == f"found 0 of 4 valid grasps in 4 candidates; {limit}"
