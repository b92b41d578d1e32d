"""Grasps that balance poorly set out once more."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.fidelity import FIDELITIES
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.fast_graspd import planner
from graspd.worker.planners.port import PlanRequest

FIDELITY = FIDELITIES["draft"].model_copy(update={"name": "custom", "finalists": 2, "coarse_iterations": 30})


def parts(count: int, threads: int = 1) -> planner.LaunchPart:
    """The grasps of a batch as one part."""
    hand, obj = hand_from_path("allegro"), object_from_path("block", face_error_m=1e-3)
    found = planner.optimise_batch(
        hand, obj, PlanRequest(count=count, fidelity=FIDELITY, seed=3), ExecutionContext(threads=threads)
    )
    assert len(found) == 1
    return found[0]


def test_what_balances_poorly_sets_out_once_more_and_the_better_one_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planner, "SET_OUT_AGAIN", np.inf)
    once = parts(6)
    limit = float(np.median(once.merit))
    monkeypatch.setattr(planner, "SET_OUT_AGAIN", limit)
    twice = parts(6)
    poor = once.merit > limit
    assert poor.sum() == 3
    np.testing.assert_array_equal(twice.state.pivot[~poor], once.state.pivot[~poor])
    moved = (twice.state.pivot != once.state.pivot).any(axis=1)
    assert moved.any()
    assert (twice.merit[moved] < once.merit[moved]).all()
    np.testing.assert_array_equal(twice.merit[~moved], once.merit[~moved])
    # A grasp is the same whatever else is made beside it, also what sets out twice.
    few = parts(3)
    for name in ("pivot", "rotation", "q"):
        np.testing.assert_array_equal(getattr(few.state, name), getattr(twice.state, name)[:3])
