"""MuJoCo Warp's clear verdicts beside the standard level's, on grasps that nobody chose."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.fidelity import FIDELITIES
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import MujocoOptions, build
from graspd.worker.validation.prefilter.prefilter import WorldPool
from graspd.worker.validation.validator import validate

GRASPS = 84


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_clear_verdicts_on_500_grasps_of_three_hands_are_the_certificates() -> None:
    """At least 99 % of them, and at least four of five verdicts are clear."""
    pytest.importorskip("mujoco_warp", reason="the prefilter needs the extra gpu")
    clear, same, kinds = list[bool](), list[bool](), set[bool]()
    for hand_name in ("allegro", "barrett", "shadow"):
        for object_name in ("bottle", "mug"):
            hand, obj = hand_from_path(hand_name), object_from_path(object_name)
            grasps = synthesize(hand, obj, PlanRequest(count=GRASPS, fidelity=FIDELITIES["draft"], seed=77))
            held = validate(hand, obj, grasps).success == 1
            found = WorldPool(build(hand, obj, decompose(obj), MujocoOptions()), "cpu", GRASPS).validate(grasps)
            assert not found.overflow.any()
            is_clear = found.clearly_held | found.clearly_failed
            clear += is_clear.tolist()
            same += (found.clearly_held == held)[is_clear].tolist()
            kinds |= set(held.tolist())
    assert kinds == {False, True}, "the set must hold both kinds"
    assert len(clear) >= 500
    assert np.mean(clear) > 0.8
    assert np.mean(same) >= 0.99
