"""Rates and expected ends of stages."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from graspd.api.catalog.jobs import TaskRates, eta_of_job, stage_statuses
from graspd.api.formatting import duration, metric, percent, size
from graspd.api.models import Job
from graspd.client.reports import JobDisplay
from graspd.service.index.views import JobView, StageProgress, TaskView
from graspd.service.model.domain import JobRequest
from graspd.service.model.states import Priority, Stage, State


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def task(done: float) -> TaskView:
    return TaskView(
        id="t",
        job_id="j",
        stage=Stage.SYNTHESIZE,
        batch=0,
        count=32,
        state=State.RUNNING,
        shard_id="s",
        attempt=1,
        worker="w",
        device="cpu",
        done=done,
        total=100.0,
        message="phase 1",
        reason=None,
        seconds=None,
        finished=None,
    )


def job(*stages: StageProgress, state: State = State.RUNNING) -> JobView:
    return JobView(
        id="j",
        state=state,
        priority=Priority.INTERACTIVE,
        request=JobRequest(hand="allegro", object="mug", grasps=64),
        hand_digest="",
        object_digest="",
        created="2026-01-01T00:00:00Z",
        finished=None,
        reason=None,
        stages=list(stages),
    )


def test_the_rate_of_a_running_batch_is_what_it_did_since_it_was_first_seen() -> None:
    clock = Clock()
    paces = TaskRates(clock)
    stage = StageProgress(stage=Stage.SYNTHESIZE, tasks=1, running=1, done=0.2)
    stage_statuses(job(stage), [task(20)], paces)
    clock.now = 10.0
    (status,) = stage_statuses(job(stage.model_copy(update={"done": 0.7})), [task(70)], paces)
    assert status.rate_per_s == pytest.approx(0.05)
    assert status.eta_s == pytest.approx(6.0)
    assert status.message == "phase 1"


def test_a_stage_that_waits_says_why() -> None:
    waits = task(0).model_copy(update={"state": State.QUEUED, "message": "held back"})
    stage = StageProgress(stage=Stage.SYNTHESIZE, tasks=1, queued=1)
    (status,) = stage_statuses(job(stage, state=State.QUEUED), [waits], TaskRates(Clock()))
    assert (status.message, status.rate_per_s) == ("held back", None)


def test_a_batch_seen_once_has_no_rate() -> None:
    (status,) = stage_statuses(
        job(StageProgress(stage=Stage.SYNTHESIZE, tasks=1, running=1, done=0.2)), [task(20)], TaskRates(Clock())
    )
    assert (status.rate_per_s, status.eta_s) == (None, None)


def test_finished_batches_give_the_rate_when_none_is_seen_running() -> None:
    stage = StageProgress(stage=Stage.SYNTHESIZE, tasks=4, queued=2, succeeded=2, done=2.0, seconds=20.0)
    (status,) = stage_statuses(job(stage), [], TaskRates(Clock()))
    assert status.eta_s == pytest.approx(20.0)


def test_reused_batches_say_nothing_of_the_rate() -> None:
    stage = StageProgress(stage=Stage.SYNTHESIZE, tasks=4, queued=1, succeeded=3, reused=2, done=3.0, seconds=10.0)
    (status,) = stage_statuses(job(stage), [], TaskRates(Clock()))
    assert status.eta_s == pytest.approx(10.0)
    old = stage.model_copy(update={"succeeded": 2, "queued": 2, "seconds": 0.0})
    assert stage_statuses(job(old), [], TaskRates(Clock()))[0].eta_s is None


def test_a_job_has_no_end_in_sight_while_the_pace_of_a_stage_is_unknown() -> None:
    known = StageProgress(stage=Stage.SYNTHESIZE, tasks=2, running=1, succeeded=1, done=1.0, seconds=10.0)
    unknown = StageProgress(stage=Stage.SCENE, tasks=2, queued=2)
    whole = job(known, unknown)
    assert eta_of_job(whole, stage_statuses(whole, [], TaskRates(Clock()))) is None
    part = job(known)
    assert eta_of_job(part, stage_statuses(part, [], TaskRates(Clock()))) == pytest.approx(10.0)


def test_without_a_terminal_progress_is_plain_lines_with_the_end_of_each_stage() -> None:
    screen = io.StringIO()
    running = StageProgress(stage=Stage.SYNTHESIZE, tasks=1, running=1, done=0.5)
    ended = StageProgress(stage=Stage.SYNTHESIZE, tasks=1, succeeded=1, done=1.0, seconds=8.0)
    with JobDisplay(Console(file=screen)) as display:
        for stage in (running, ended):
            view = job(stage)
            display.update(
                Job(
                    id="j",
                    state=State.RUNNING,
                    hand="h",
                    object="o",
                    method="m",
                    fidelity="f",
                    requested=32,
                    grasps=0,
                    valid=0,
                    progress=0.5,
                    created="",
                    stages=stage_statuses(view, [], TaskRates(Clock())),
                )
            )
    first, last = screen.getvalue().splitlines()
    assert ("running" in first, "50 %" in first) == (True, True)
    assert ("succeeded" in last, "8.0 s" in last) == (True, True)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (0, "0"),
        (2.5e-7, "< 0.001"),
        (0.12345, "0.123"),
        (34.2, "34.2"),
        (12345, "12,345"),
    ],
)
def test_a_metric_is_said_with_three_digits(value: float | None, text: str) -> None:
    assert metric(value) == text


@pytest.mark.parametrize(("value", "text"), [(0, "0 %"), (0.999, "99 %"), (1.0, "100 %"), (0.004, "0.4 %")])
def test_a_share_is_100_per_cent_only_when_it_is_all(value: float, text: str) -> None:
    assert percent(value) == text


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.52, "0.5 s"), (42, "42 s"), (61, "1 min 1 s"), (3661, "1 h 1 min"), (200000, "2 d 7 h")]
)
def test_a_time_span_is_said_in_its_two_largest_units(seconds: float, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("value", "text"), [(12, "12 B"), (1234, "1.2 kB"), (123456, "123 kB"), (67_108_864, "67.1 MB")]
)
def test_bytes_are_said_in_decimal_units(value: float, text: str) -> None:
    assert size(value) == text
