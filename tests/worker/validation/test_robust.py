"""Robustness: the share of models in which a grasp holds, and when it is sure."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import TaskCancelled
from graspd.service.model.metrics import Axis
from graspd.worker.control.postures import pregrasp, squeeze
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.validation import robust as robustness
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.protocol import Outcome, Rollout
from graspd.worker.validation.robust import Robustness, models_of, needed, robust
from graspd.worker.validation.validator import validate
from graspd.worker.validation.variant import NOMINAL, Variant, axes_of
from graspd.worker.validation.varied import Models
from tests.worker.models import object_from_mesh
from tests.worker.quality.helpers import pad_hand, posture

BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
WHOLE = ConvexPieces((BOX.hull_vertices,), 1.0, 0.0, "box")
PADS = dataclasses.replace(pad_hand(), upper=np.full(2, 0.2))


def many_grasps(count: int = 8) -> GraspSet:
    """Pads that hold the box ever nearer to its edge, from firm to none at all."""
    contact = posture(*[((0, 0, z), (0.065, 0.065)) for z in np.linspace(0.0, 0.055, count)])
    return GraspSet(contact, pregrasp(PADS, BOX, contact), squeeze(PADS, BOX, contact), np.full(count, np.nan))


def by_luck(monkeypatch: pytest.MonkeyPatch, odds: float = 0.7) -> None:
    """Verdicts that follow from the grasp and the variant as a coin does."""

    def standard(self: Models, grasps: GraspSet, row: int, variant: Variant) -> Rollout:
        words = np.frombuffer(repr((variant, grasps.grasp.hand_pose[row].tolist())).encode(), np.uint8)
        if np.random.default_rng(words.tolist()).random() < odds:
            return Rollout([Outcome.HELD] * 6)
        return Rollout().fail(Outcome.DISPLACED)

    monkeypatch.setattr(Models, "standard", standard)


def test_in_models_that_are_all_the_same_a_grasp_holds_in_all_or_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robustness, "draw", lambda axis, hand, rng: NOMINAL)
    grasps = many_grasps()
    found = robust(PADS, BOX, grasps, models=3, pieces=WHOLE)
    verdicts = validate(PADS, BOX, grasps, pieces=WHOLE)
    assert found.share.tolist() == verdicts.success.tolist()
    assert {0.0, 1.0} == set(found.share)
    assert ((found.weakest == Axis.NONE) == (verdicts.success == 1)).all()


def test_only_what_holds_in_the_nominal_model_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    by_luck(monkeypatch)
    held = np.array([1, 0, 1, -1, 0, 1, 1, 1])
    found = robust(PADS, BOX, many_grasps(), held=held, models=4, pieces=WHOLE)
    assert (np.isfinite(found.share) == (held == 1)).all()
    assert (found.weakest[held != 1] == Axis.NONE).all()


@pytest.mark.parametrize("models", [1, 8])
@pytest.mark.parametrize("wanted", [0.25, 0.75, 0.9])
def test_judging_that_ends_early_says_of_the_wanted_share_what_all_models_say(
    monkeypatch: pytest.MonkeyPatch, models: int, wanted: float
) -> None:
    by_luck(monkeypatch)
    grasps = many_grasps(24)
    whole = robust(PADS, BOX, grasps, models=models, pieces=WHOLE)
    early = robust(PADS, BOX, grasps, models=models, wanted=wanted, pieces=WHOLE)
    assert ((early.share >= wanted - 1e-9) == (whole.share >= wanted - 1e-9)).all()
    reached = whole.share >= wanted - 1e-9
    # What is told of a share is a bound on its right side.
    assert (early.share[reached] <= whole.share[reached]).all()
    assert (early.share[~reached] >= whole.share[~reached]).all()
    validated = early.held >= 0
    assert (early.held[validated] == whole.held[validated]).all()
    assert models == 1 or validated.sum() < whole.held.size


def test_no_model_is_validated_after_the_share_is_sure(monkeypatch: pytest.MonkeyPatch) -> None:
    by_luck(monkeypatch, odds=0.0)
    found = robust(PADS, BOX, many_grasps(), models=8, wanted=0.9, pieces=WHOLE)
    assert ((found.held >= 0).sum(axis=1) == 1).all()
    by_luck(monkeypatch, odds=1.0)
    found = robust(PADS, BOX, many_grasps(), models=8, wanted=0.5, pieces=WHOLE)
    assert ((found.held >= 0).sum(axis=1) == 4).all()
    assert (found.share == 0.5).all()


def test_the_weakest_axis_is_that_of_the_first_model_that_fails() -> None:
    held = np.array([[1, 0, 0], [1, 1, 1], [0, -1, -1], [-1, -1, -1]], np.int8)
    axis = np.array([[1, 4, 5], [2, 3, 4], [7, 0, 0], [0, 0, 0]], np.uint8)
    found = Robustness(held, axis, 0.9, 0.0)
    assert found.weakest.tolist() == [4, 0, 7, 0]
    assert found.by_axis() == {
        Axis.SHAPES: (1, 1), Axis.JOINTS: (1, 1), Axis.COUPLINGS: (1, 1), Axis.FRICTION: (1, 2), Axis.MASS: (0, 1),
        Axis.POSE: (0, 1),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("wanted", "models", "least"), [(0.9, 8, 8), (0.75, 8, 6), (0.9, 10, 9), (1.0, 3, 3), (0.1, 4, 1)]
)
def test_so_many_models_make_a_share(wanted: float, models: int, least: int) -> None:
    assert needed(wanted, models) == least


def test_a_grasp_meets_the_same_models_wherever_it_stands() -> None:
    grasps = many_grasps()
    turned = grasps.take(np.arange(len(grasps))[::-1])
    assert models_of(PADS, grasps, 2, 8, 5) == models_of(PADS, turned, len(grasps) - 3, 8, 5)
    assert models_of(PADS, grasps, 2, 8, 5) == models_of(PADS, grasps, 2, 16, 5)[:8]
    others = [models_of(PADS, grasps, 2, 8, 6), models_of(PADS, grasps, 3, 8, 5)]
    assert models_of(PADS, grasps, 2, 8, 5) not in others


def test_eight_models_of_a_hand_without_couplings_have_each_axis_once() -> None:
    axes = [axis for axis, _ in models_of(PADS, many_grasps(), 0, 8, 0)]
    assert sorted(axes) == sorted(axes_of(PADS))
    assert len(axes) == 8


def test_it_stops_when_it_is_told_to() -> None:
    with pytest.raises(TaskCancelled):
        robust(PADS, BOX, many_grasps(), pieces=WHOLE, run=ExecutionContext(cancelled=lambda: True))
