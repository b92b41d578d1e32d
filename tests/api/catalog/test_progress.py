"""Rates and expected ends of stages."""

import io
import math
from typing import Any

import pytest
from rich.console import Console

from graspd.api.catalog.jobs import TaskRates, eta_of_job, stage_statuses
from graspd.api.formatting import duration, metric, percent, size
from graspd.api.models import Job, StageStatus
from graspd.client.reports import JobDisplay
from graspd.service.index.views import JobView, StageProgress, TaskView
from graspd.service.model.domain import JobRequest
from graspd.service.model.states import Priority, Stage, State
from tests.waiting import Clock


def task(done: float) -> TaskView:
    what = {"id": "t", "job_id": "j", "stage": Stage.SYNTHESIZE, "batch": 0, "count": 32, "shard_id": "s"}
    running = {"state": State.RUNNING, "attempt": 1, "worker": "w", "device": "cpu", "total": 100.0}
    ended = dict.fromkeys(("reason", "seconds", "finished"))
    return TaskView(**what, **running, **ended, done=done, message="phase 1")


def job(*stages: StageProgress, state: State = State.RUNNING) -> JobView:
    request = JobRequest(hand="allegro", object="mug", grasps=64)
    what = {"id": "j", "priority": Priority.INTERACTIVE, "hand_digest": "", "object_digest": ""}
    what |= dict.fromkeys(("finished", "reason"))
    return JobView(**what, state=state, request=request, created="2026-01-01T00:00:00Z", stages=list(stages))


def status_of(stage: StageProgress, *tasks: TaskView, paces: TaskRates | None = None, **of: Any) -> StageStatus:
    (status,) = stage_statuses(job(stage, **of), list(tasks), paces or TaskRates(Clock()))
    return status


def test_the_rate_of_a_batch_is_what_it_did_since_first_seen() -> None:
    clock = Clock()
    paces = TaskRates(clock)
    stage = StageProgress(stage=Stage.SYNTHESIZE, tasks=1, running=1, done=0.2)
    once = status_of(stage, task(20), paces=paces)
    assert (once.rate_per_s, once.eta_s) == (None, None)
    clock.now += 10.0
    status = status_of(stage.model_copy(update={"done": 0.7}), task(70), paces=paces)
    assert status.rate_per_s == pytest.approx(0.05) and status.eta_s == pytest.approx(6.0)
    assert status.message == "phase 1"


def test_a_stage_that_waits_says_why() -> None:
    waits = task(0).model_copy(update={"state": State.QUEUED, "message": "held back"})
    status = status_of(StageProgress(stage=Stage.SYNTHESIZE, tasks=1, queued=1), waits, state=State.QUEUED)
    assert (status.message, status.rate_per_s) == ("held back", None)


@pytest.mark.parametrize(
    ("queued", "succeeded", "reused", "seconds", "eta"),
    [(2, 2, 0, 20.0, pytest.approx(20.0)), (1, 3, 2, 10.0, pytest.approx(10.0)), (2, 2, 2, 0.0, None)],
)
def test_new_batches_give_the_rate(queued: int, succeeded: int, reused: int, seconds: float, eta: Any) -> None:
    counts = {"tasks": 4, "queued": queued, "succeeded": succeeded, "reused": reused, "done": float(succeeded)}
    assert status_of(StageProgress(stage=Stage.SYNTHESIZE, seconds=seconds, **counts)).eta_s == eta


def test_a_job_has_no_end_in_sight_while_a_pace_is_unknown() -> None:
    known = StageProgress(stage=Stage.SYNTHESIZE, tasks=2, running=1, succeeded=1, done=1.0, seconds=10.0)
    unknown = StageProgress(stage=Stage.SCENE, tasks=2, queued=2)
    whole = job(known, unknown)
    assert eta_of_job(whole, stage_statuses(whole, [], TaskRates(Clock()))) is None
    part = job(known)
    assert eta_of_job(part, stage_statuses(part, [], TaskRates(Clock()))) == pytest.approx(10.0)


def test_without_a_terminal_progress_is_plain_lines() -> None:
    screen = io.StringIO()
    running = StageProgress(stage=Stage.SYNTHESIZE, tasks=1, running=1, done=0.5)
    ended = StageProgress(stage=Stage.SYNTHESIZE, tasks=1, succeeded=1, done=1.0, seconds=8.0)
    words = dict.fromkeys(("id", "hand", "object", "method", "fidelity", "created"), "x")
    numbers = {"requested": 32, "grasps": 0, "valid": 0, "progress": 0.5}
    with JobDisplay(Console(file=screen)) as display:
        for stage in (running, ended):
            display.show(Job(**words, **numbers, state=State.RUNNING, stages=[status_of(stage)]))
    first, last = screen.getvalue().splitlines()
    assert ("running" in first, "50 %" in first) == (True, True)
    assert ("succeeded" in last, "8.0 s" in last) == (True, True)


def test_numbers_are_said_as_people_read_them() -> None:
    """Three digits; 100 per cent only when it is all; the two largest units of a time; decimal units of bytes."""
    metrics = {"–": math.nan, "0": 0, "< 0.001": 2.5e-7, "0.123": 0.12345, "34.2": 34.2, "12,345": 12345}
    assert [metric(value) for value in (None, *metrics.values())] == ["–", *metrics]
    shares = {"0 %": 0, "99 %": 0.999, "100 %": 1.0, "0.4 %": 0.004}
    assert [percent(value) for value in shares.values()] == [*shares]
    spans = {"0.5 s": 0.52, "42 s": 42, "1 min 1 s": 61, "1 h 1 min": 3661, "2 d 7 h": 200000}
    assert [duration(value) for value in spans.values()] == [*spans]
    sizes = {"12 B": 12, "1.2 kB": 1234, "123 kB": 123456, "67.1 MB": 67_108_864}
    assert [size(value) for value in sizes.values()] == [*sizes]
