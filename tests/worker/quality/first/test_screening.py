"""The first judge beside the CPU: who judges what, and what becomes of verdicts that the CPU contradicts."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from service.model.domain import JobOptions
from service.model.errors import InputError
from service.store.columns import SCHEMAS
from tests.worker.quality.first.engine import Stand
from tests.worker.quality.first.test_worlds import every_kind
from tests.worker.quality.test_referee import BOX, PADS, WHOLE
from worker.certified import scored
from worker.grasps import GraspSet
from worker.quality.referee.first import screening, trials
from worker.quality.referee.first.trials import FirstTrials
from worker.quality.referee.judge import Verdicts, judge, prefiltered
from worker.quality.referee.key import Level
from worker.quality.referee.protocol import JudgedBy
from worker.run import Run

ON = Run(first_judge="on", threads=1)


@pytest.fixture(autouse=True)
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stand]:
    """MuJoCo itself as the engine; the pads pass for a hand, which grippers do not."""
    engine = Stand()
    monkeypatch.setattr(screening, "mujoco_warp", lambda: engine)
    monkeypatch.setattr(screening, "mujoco_warp_version", lambda: "stand-in 1")
    monkeypatch.setattr(screening, "jaws_of", lambda hand: None)
    monkeypatch.setattr(screening, "AUDIT_ONE_IN", 1 << 62)
    screening._pools.clear()
    yield engine
    screening._pools.clear()


def verdicts(run: Run, level: Level = "certificate", grasps: GraspSet | None = None) -> Verdicts:
    return judge(PADS, BOX, grasps or every_kind(), level=level, pieces=WHOLE, run=run)


def test_at_level_certificate_the_first_judge_only_refuses() -> None:
    alone, found = verdicts(Run()), verdicts(ON)
    np.testing.assert_array_equal(found.outcome, alone.outcome)
    assert (found.judged_by[found.success == 1] == JudgedBy.MUJOCO).all()
    assert (found.judged_by == JudgedBy.MUJOCO_WARP).any()
    assert (alone.judged_by == JudgedBy.MUJOCO).all()


def test_at_level_screen_clear_verdicts_stand_both_ways_and_the_band_is_the_cpus(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = verdicts(ON, "screen")
    for held in (0, 1):
        assert (first.judged_by[first.success == held] == JudgedBy.MUJOCO_WARP).any()
    certificate = verdicts(Run())
    assert first.level == "screen"
    np.testing.assert_array_equal(first.success, certificate.success)
    monkeypatch.setattr(trials, "BAND", (0.0, 1e9))
    band = verdicts(ON, "screen")
    inside = band.outcome[:, 0] == 2
    assert (band.judged_by[~inside] == JudgedBy.MUJOCO).all()
    np.testing.assert_array_equal(band.margin[~inside], certificate.margin[~inside])


def test_the_letter_knows_no_first_judge() -> None:
    found = verdicts(ON, "letter")
    assert (found.judged_by == JudgedBy.MUJOCO).all()
    assert found.terms == verdicts(Run(), "letter").terms


def test_the_key_says_who_judges() -> None:
    keys = {verdicts(run).terms for run in (Run(), Run(first_judge="off"), Run(device="cpu", first_judge="auto"))}
    assert len(keys) == 1
    assert verdicts(ON).terms not in keys


def test_grippers_are_the_cpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(screening, "jaws_of", lambda hand: object())
    assert screening.first_terms(PADS, "certificate", ON) == []


def test_who_insists_on_it_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(screening, "jaws_of", lambda hand: None)
    monkeypatch.setattr(screening, "has_mujoco_warp", lambda: False)
    with pytest.raises(InputError, match=r"pip install 'graspd\[gpu\]'"):
        verdicts(ON)


def lies(found: FirstTrials) -> FirstTrials:
    """Of every grasp that fails the first judge says that it clearly holds."""
    return dataclasses.replace(found, outcome=np.ones_like(found.outcome), margin=np.zeros(len(found.margin)))


def test_a_first_judge_that_the_cpu_contradicts_is_not_believed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    true = screening.WorldPool.judge
    monkeypatch.setattr(screening.WorldPool, "judge", lambda *some, **more: lies(true(*some, **more)))
    unaudited = verdicts(ON, "screen")
    assert unaudited.success.all()
    assert unaudited.audited == 0
    monkeypatch.setattr(screening, "AUDIT_ONE_IN", 2)
    with caplog.at_level(logging.WARNING):
        found = verdicts(ON, "screen")
    assert found.contradicted > 1
    assert found.audited >= found.contradicted
    assert (found.judged_by == JudgedBy.MUJOCO).all()
    np.testing.assert_array_equal(found.success, verdicts(Run()).success)
    assert "the CPU judges all" in caplog.text


def test_where_a_gpu_has_no_memory_for_it_the_cpu_judges(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: Any) -> Any:
        raise RuntimeError("Failed to allocate 4096 bytes on device 'cuda:0'")

    monkeypatch.setattr(screening, "WorldPool", full)
    with caplog.at_level(logging.WARNING):
        found = verdicts(ON)
    assert (found.judged_by == JudgedBy.MUJOCO).all()
    assert "no memory for the first judge" in caplog.text


def test_an_audit_follows_the_grasp_and_not_its_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(screening, "AUDIT_ONE_IN", 2)
    grasps = every_kind()
    drawn = screening._drawn(grasps)
    assert 0 < drawn.sum() < len(grasps)
    np.testing.assert_array_equal(screening._drawn(grasps.take(np.arange(3, 9))), drawn[3:9])


@pytest.mark.parametrize("mode", ["on", "off"])
def test_a_shard_tells_of_each_grasp_who_judged_it(mode: Any) -> None:
    request = JobOptions(grasps=1, referee="screen", want="raw", audits=0)
    run = Run(first_judge=mode, threads=1)
    found = scored(PADS, BOX, every_kind(), request, pieces=lambda obj: WHOLE, run=run)
    columns = found.columns
    assert ("quality/judged_by" in columns) == (mode == "on")
    assert found.verdict_key == verdicts(run, "screen").terms
    if mode == "on":
        assert (columns["quality/judged_by"] == JudgedBy.MUJOCO_WARP).any()
        assert columns.keys() <= SCHEMAS["base"].keys()


def test_verdicts_of_the_gpu_prefilter_that_were_asked_before_are_those_of_the_judge(stand_in: Stand) -> None:
    run, made = ON.quiet(), verdicts(ON, "screen")
    known = prefiltered(PADS, BOX, every_kind(), level="screen", pieces=WHOLE, run=run)
    launched = stand_in.steps
    again = judge(PADS, BOX, every_kind(), level="screen", pieces=WHOLE, prefilter=known, run=run)
    assert stand_in.steps == launched > 0, "it is not asked twice"
    np.testing.assert_array_equal(again.outcome, made.outcome)
    np.testing.assert_array_equal(again.judged_by, made.judged_by)
