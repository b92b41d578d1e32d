"""The prefilter beside the CPU: who validates what, and what becomes of verdicts that the CPU contradicts."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.store.columns import SCHEMAS
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.generation import scored
from graspd.worker.grasps import GraspSet
from graspd.worker.validation.key import Level
from graspd.worker.validation.prefilter import phases as rollouts
from graspd.worker.validation.prefilter import prefilter as screening
from graspd.worker.validation.prefilter.phases import PrefilterOutcomes
from graspd.worker.validation.protocol import ValidatedBy
from graspd.worker.validation.validator import Verdicts, prefiltered, validate
from tests.worker.validation.prefilter.engine import Stand
from tests.worker.validation.prefilter.test_worlds import every_kind
from tests.worker.validation.test_validator import BOX, PADS, WHOLE

ON = ExecutionContext(prefilter="on", threads=1)


@pytest.fixture(autouse=True)
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stand]:
    """MuJoCo itself as the engine; the pads pass for a hand, which grippers do not."""
    engine = Stand()
    monkeypatch.setattr(screening, "mujoco_warp", lambda: engine)
    monkeypatch.setattr(screening, "mujoco_warp_version", lambda: "stand-in 1")
    monkeypatch.setattr(screening, "jaws_of", lambda hand: None)
    monkeypatch.setattr(screening, "RECHECK_ONE_IN", 1 << 62)
    screening._pools.clear()
    yield engine
    screening._pools.clear()


def verdicts(run: ExecutionContext, level: Level = "standard", grasps: GraspSet | None = None) -> Verdicts:
    return validate(PADS, BOX, grasps or every_kind(), level=level, pieces=WHOLE, run=run)


def test_at_level_certificate_the_first_judge_only_refuses() -> None:
    alone, found = verdicts(ExecutionContext()), verdicts(ON)
    np.testing.assert_array_equal(found.outcome, alone.outcome)
    assert (found.validated_by[found.success == 1] == ValidatedBy.MUJOCO).all()
    assert (found.validated_by == ValidatedBy.MUJOCO_WARP).any()
    assert (alone.validated_by == ValidatedBy.MUJOCO).all()


def test_at_level_screen_clear_verdicts_stand_both_ways_and_the_band_is_the_cpus(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = verdicts(ON, "fast")
    for held in (0, 1):
        assert (first.validated_by[first.success == held] == ValidatedBy.MUJOCO_WARP).any()
    standard = verdicts(ExecutionContext())
    assert first.level == "fast"
    np.testing.assert_array_equal(first.success, standard.success)
    monkeypatch.setattr(rollouts, "BAND", (0.0, 1e9))
    band = verdicts(ON, "fast")
    inside = band.outcome[:, 0] == 2
    assert (band.validated_by[~inside] == ValidatedBy.MUJOCO).all()
    np.testing.assert_array_equal(band.margin[~inside], standard.margin[~inside])


def test_the_letter_knows_no_first_judge() -> None:
    found = verdicts(ON, "dexgraspbench")
    assert (found.validated_by == ValidatedBy.MUJOCO).all()
    assert found.terms == verdicts(ExecutionContext(), "dexgraspbench").terms


def test_the_key_says_who_judges() -> None:
    keys = {
        verdicts(run).terms
        for run in (
            ExecutionContext(),
            ExecutionContext(prefilter="off"),
            ExecutionContext(device="cpu", prefilter="auto"),
        )
    }
    assert len(keys) == 1
    assert verdicts(ON).terms not in keys


def test_grippers_are_the_cpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(screening, "jaws_of", lambda hand: object())
    assert screening.first_terms(PADS, "standard", ON) == []


def test_who_insists_on_it_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(screening, "jaws_of", lambda hand: None)
    monkeypatch.setattr(screening, "has_mujoco_warp", lambda: False)
    with pytest.raises(InputError, match=r"pip install 'graspd\[gpu\]'"):
        verdicts(ON)


def lies(found: PrefilterOutcomes) -> PrefilterOutcomes:
    """Of every grasp that fails the prefilter says that it clearly holds."""
    return dataclasses.replace(found, outcome=np.ones_like(found.outcome), margin=np.zeros(len(found.margin)))


def test_a_first_judge_that_the_cpu_contradicts_is_not_believed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    true = screening.WorldPool.validate
    monkeypatch.setattr(screening.WorldPool, "validate", lambda *some, **more: lies(true(*some, **more)))
    not_rechecked = verdicts(ON, "fast")
    assert not_rechecked.success.all()
    assert not_rechecked.rechecked == 0
    monkeypatch.setattr(screening, "RECHECK_ONE_IN", 2)
    with caplog.at_level(logging.WARNING):
        found = verdicts(ON, "fast")
    assert found.contradicted > 1
    assert found.rechecked >= found.contradicted
    assert (found.validated_by == ValidatedBy.MUJOCO).all()
    np.testing.assert_array_equal(found.success, verdicts(ExecutionContext()).success)
    assert "the CPU validates all" in caplog.text


def test_where_a_gpu_has_no_memory_for_it_the_cpu_judges(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: Any) -> Any:
        raise RuntimeError("Failed to allocate 4096 bytes on device 'cuda:0'")

    monkeypatch.setattr(screening, "WorldPool", full)
    with caplog.at_level(logging.WARNING):
        found = verdicts(ON)
    assert (found.validated_by == ValidatedBy.MUJOCO).all()
    assert "no memory for the prefilter" in caplog.text


def test_an_audit_follows_the_grasp_and_not_its_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(screening, "RECHECK_ONE_IN", 2)
    grasps = every_kind()
    drawn = screening._drawn(grasps)
    assert 0 < drawn.sum() < len(grasps)
    np.testing.assert_array_equal(screening._drawn(grasps.take(np.arange(3, 9))), drawn[3:9])


@pytest.mark.parametrize("mode", ["on", "off"])
def test_a_shard_tells_of_each_grasp_who_validated_it(mode: Any) -> None:
    request = JobOptions(grasps=1, validation="fast", want="candidates", rechecks=0)
    run = ExecutionContext(prefilter=mode, threads=1)
    found = scored(PADS, BOX, every_kind(), request, pieces=lambda obj: WHOLE, run=run)
    columns = found.columns
    assert ("quality/validated_by" in columns) == (mode == "on")
    assert found.verdict_key == verdicts(run, "fast").terms
    if mode == "on":
        assert (columns["quality/validated_by"] == ValidatedBy.MUJOCO_WARP).any()
        assert columns.keys() <= SCHEMAS["base"].keys()


def test_verdicts_of_the_gpu_prefilter_that_were_asked_before_are_those_of_the_judge(stand_in: Stand) -> None:
    run, made = ON.quiet(), verdicts(ON, "fast")
    known = prefiltered(PADS, BOX, every_kind(), level="fast", pieces=WHOLE, run=run)
    launched = stand_in.steps
    again = validate(PADS, BOX, every_kind(), level="fast", pieces=WHOLE, prefilter=known, run=run)
    assert stand_in.steps == launched > 0, "it is not asked twice"
    np.testing.assert_array_equal(again.outcome, made.outcome)
    np.testing.assert_array_equal(again.validated_by, made.validated_by)
