"""What a hand lifts at best: bounded by a linear program, measured, and told where none of its grasps lifts enough."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from graspd.cli import build
from graspd.service.model.matter import ACCELERATION, FRICTION
from graspd.worker.grasps import Posture
from graspd.worker.quality.wrench_space import EDGES
from graspd.worker.validation.payload import AT_STOP, ENOUGH, HOPELESS, LEAST, Limit, capacities, limit_of
from tests.worker.validation.test_mass import BOX, HAND, LEVER_M, PIECES, TABLE, TORQUE, pinch

UP = np.array([[[0.0, 1.0, 0.0]]])


def bears(friction: float) -> float:
    return 2 * friction * TORQUE / LEVER_M / ACCELERATION


@pytest.mark.parametrize("friction", [0.01, 0.3, FRICTION, 1.0])
def test_a_pinch_could_bear_what_the_pyramids_around_its_cones_bear(friction: float) -> None:
    found = capacities(HAND, BOX.weighing(friction=friction), pinch().grasp, UP)
    assert found == pytest.approx(bears(friction) / math.cos(math.pi / EDGES), rel=2e-3)


def test_of_several_directions_the_worst_counts() -> None:
    # Along the line of the fingers one of them presses with all its effort, the other not at all.
    along = np.array([[[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]])
    assert capacities(HAND, BOX, pinch().grasp, along) == pytest.approx(TORQUE / LEVER_M / ACCELERATION, rel=0.01)


def test_the_stop_of_a_joint_bears_what_no_actuator_does() -> None:
    at_stop = replace(HAND, lower=np.full(2, -AT_STOP * 1e-3))
    assert not np.isfinite(capacities(at_stop, BOX, pinch().grasp, UP)).any()


def test_what_touches_nothing_bears_nothing() -> None:
    away = Posture(pinch().grasp.hand_pose - np.eye(7)[2], pinch().grasp.joint_positions)
    assert capacities(HAND, BOX, away, UP).tolist() == [0.0]


def test_what_is_wanted_is_told_with_what_the_best_grasp_lifts() -> None:
    grasps = pinch().take(np.zeros(ENOUGH, int))
    placed = TABLE.take(np.zeros(ENOUGH, int))

    def limit(wanted: float, count: int = ENOUGH) -> Limit | None:
        rows = np.arange(count)
        return limit_of(HAND, BOX, grasps.take(rows), pieces=PIECES, placed=placed.take(rows), wanted=wanted)

    lifts = bears(FRICTION)
    found = limit(3 * lifts)
    assert found is not None and found.hopeless
    assert 0.95 * lifts < found.lifts_kg < lifts < found.bound_kg < 1.1 * lifts
    assert found.line == (
        "two_finger lifts 0.34 kg at friction 0.6 in the best of 8 grasps, and at most 0.38 kg by actuator effort; "
        "1.06 kg are wanted"
    )
    near = limit(0.9 * HOPELESS * lifts)
    assert near is not None and not near.hopeless
    assert limit(0.9 * lifts) is None, "they lift it"
    few = limit(3 * lifts, ENOUGH - 1)
    assert few is not None and not few.hopeless, "it may be their shape"
    assert limit(3 * lifts, LEAST - 1) is None, "too few to tell"


@pytest.mark.parametrize("wanted", [ENOUGH // 2, ENOUGH])
def test_a_weight_out_of_reach_ends_the_work_with_what_the_hand_lifts(tmp_path: Path, wanted: int) -> None:
    words = [
        "synth",
        "--hand",
        "allegro",
        "--object",
        "block",
        "--mass",
        "20",
        "--scene",
        "table",
        "-n",
        str(wanted),
        "--fidelity",
        "draft",
        "--seed",
        "3",
        "--json",
        "-o",
        str(tmp_path / "g.h5"),
    ]
    result = CliRunner().invoke(build(), words)
    told = json.loads(result.stdout.splitlines()[-1])
    assert result.exit_code == 3
    assert (told["grasps"], told["tried"]) == (0, wanted), "the budget would be four times as many"
    assert 0.3 < told["limit"]["lifts_kg"] <= told["limit"]["bound_kg"] < 10
    tries = wanted + told["outcomes"]["repeated"]
    assert told["reason"].startswith(f"found 0 of {wanted} valid grasps in {tries} tries: ")
    assert told["reason"].endswith(told["limit"]["says"]) and "20 kg are wanted" in told["reason"]
