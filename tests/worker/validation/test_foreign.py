"""Grasps validated in another model of their hand: what moves with the model, and what stays with the grasp."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from graspd.studies.evaluation import combine, evaluate
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.model import Drag, HandModel
from graspd.worker.hands.same_hand import same_hand
from graspd.worker.validation.foreign import driven_as, in_other_model, with_our_shapes, with_their_shapes
from graspd.worker.validation.key import verdict_key
from graspd.worker.validation.model import MujocoOptions, Scene, build
from graspd.worker.validation.prefilter.prefilter import first_terms
from tests.studies.test_evaluation import BOX, HAND, plates_case
from tests.worker.hands.mjcfs import CLAW
from tests.worker.hands.test_mjcf import load
from tests.worker.quality.helpers import FAR, WHOLE, placed_data


def driven(hand: HandModel, begin: np.ndarray, aim: np.ndarray) -> tuple[Scene, mujoco.MjData]:
    """A hand far from everything whose dofs (D,) are driven to an aim."""
    scene = build(hand, BOX, WHOLE, MujocoOptions())
    data = placed_data(scene, hand.expand(begin))
    scene.command(data, FAR, hand.expand(aim))
    return scene, data


def test_a_tendon_moves_the_sum_and_pulls_by_its_coefficients() -> None:
    hand = load(root="palm")
    bend, curl = (hand.dof_names.index(name) for name in ("left_bend", "left_curl"))
    aim = hand.preshape.copy()
    aim[[bend, curl]] = 0.5, 0.4
    scene, data = driven(hand, hand.preshape, aim)
    assert scene.model.nu == hand.dofs - 1
    mujoco.mj_step(scene.model, data, nstep=1)
    body = {name: hand.joint_body[hand.joint_names.index(name)] for name in ("left_bend", "left_curl")}
    force = [float(data.joint(f"joint{body[name]}").qfrc_actuator[0]) for name in body]
    assert force[1] == pytest.approx(0.5 * force[0])
    mujoco.mj_step(scene.model, data, nstep=1000)
    q = hand.reduce(data.qpos[scene.joint_qpos])
    # Nothing else pulls: after 4 s what is left is below a thousandth of a radian. How the joints share it is open.
    assert q[bend] + 0.5 * q[curl] == pytest.approx(0.5 + 0.5 * 0.4, abs=1e-3)


def test_one_joint_of_tendon_takes_what_limit_of_other_leaves() -> None:
    hand = load(root="palm")
    bend, curl, spread = (hand.dof_names.index(f"left_{name}") for name in ("bend", "curl", "spread"))
    upper = hand.upper.copy()
    upper[curl] = 0.1
    begin = hand.preshape.copy()
    begin[spread] = -0.2  # past the other finger
    aim = begin.copy()
    aim[[bend, curl]] = 0.5, 0.8
    scene, data = driven(dataclasses.replace(hand, upper=upper), begin, aim)
    mujoco.mj_step(scene.model, data, nstep=1500)
    q = hand.reduce(data.qpos[scene.joint_qpos])
    # A limit gives way to torques by less than a milliradian.
    assert q[curl] == pytest.approx(0.1, abs=1e-3)
    assert q[bend] == pytest.approx(0.5 + 0.5 * (0.8 - q[curl]), abs=1e-3)


def test_the_first_judge_and_the_key_know_of_tendons() -> None:
    hand = load(root="palm")
    separate = dataclasses.replace(hand, tendons=())
    dragged = dataclasses.replace(separate, drag=Drag(np.zeros(hand.bodies), np.zeros(hand.bodies)))
    keys = {verdict_key(one, BOX, "standard", False, pieces=WHOLE) for one in (hand, separate, dragged)}
    assert len(keys) == 3
    assert first_terms(load(root="palm"), "standard", ExecutionContext(prefilter="on")) == []


def test_a_drive_stays_what_it_is_with_followers_or_on_a_tendon() -> None:
    text = CLAW.replace('joint="left_curl" coef="0.5"', 'joint="left_curl" coef="1"')
    tendon = load(text, root="palm")
    ratio = load(text, root="palm", tendons={}, couplings={"left_curl": {"of": "left_bend"}})
    (cord,), dof = tendon.tendons, ratio.dof_names.index("left_bend")
    # Both joints by the same angle q change the tendon's length by 2 q: its gain K is 4 K to q, its limit F is 2 F.
    forth, back = driven_as(same_hand(tendon, ratio)), driven_as(same_hand(ratio, tendon))
    assert forth.stiffness[dof] == pytest.approx(4 * cord.gain(tendon.stiffness))
    assert forth.effort[dof] == pytest.approx(2 * cord.limit(tendon.effort))
    assert 4 * cord.gain(back.stiffness) == pytest.approx(ratio.stiffness[dof])
    assert 2 * cord.limit(back.effort) == pytest.approx(ratio.effort[dof])


def test_the_same_model_gives_the_same_verdicts(tmp_path: Path) -> None:
    row = evaluate(plates_case(), validation_hand=same_hand(HAND, HAND), cache=tmp_path)
    assert row["foreign_held"] == {"both": 2, "nominal": 0, "foreign": 0, "neither": 1}
    assert (row["agreement"], row["foreign_share"], row["fingertips_mm"]) == (1.0, 1.0, pytest.approx(0.0, abs=1e-6))
    assert [one["held_foreign"] for one in row["verdicts"]] == [True, True, False]
    json.dumps(row, allow_nan=False)


def test_a_model_with_other_pads_says_otherwise(tmp_path: Path) -> None:
    # The other model's pads do not reach the object: they are 40 mm nearer to their joints.
    back, (foot, *pads) = np.array([0, 0, -0.04, 0, 0, 0, 0]), HAND.pieces
    moved = (dataclasses.replace(p, vertices=p.vertices + back[:3], pose=p.pose + back) for p in pads)
    other = dataclasses.replace(HAND, name="shorter", pieces=(foot, *moved))
    same = same_hand(HAND, other)
    row = evaluate(plates_case(), validation_hand=same, cache=tmp_path)
    assert row["foreign_held"] == {"both": 0, "nominal": 2, "foreign": 0, "neither": 1}
    assert (row["foreign_share"], row["agreement"]) == (0.0, pytest.approx(1 / 3))
    ours_in_theirs = dataclasses.replace(same, theirs=with_our_shapes(same))
    assert evaluate(plates_case(), validation_hand=ours_in_theirs, cache=tmp_path)["foreign_share"] == 1.0
    theirs_in_ours = dataclasses.replace(same, theirs=with_their_shapes(same))
    assert evaluate(plates_case(), validation_hand=theirs_in_ours, cache=tmp_path)["foreign_share"] == 0.0


def test_rows_add_up_by_their_grasps(tmp_path: Path) -> None:
    row = evaluate(plates_case(), validation_hand=same_hand(HAND, HAND), cache=tmp_path)
    lost = {**row, "foreign_held": {"both": 0, "nominal": 1, "foreign": 1, "neither": 0}, "fingertips_mm": 0.4}
    whole = combine([row, lost])
    assert whole["foreign_held"] == {"both": 2, "nominal": 1, "foreign": 1, "neither": 1}
    assert (whole["agreement"], whole["foreign_share"]) == (pytest.approx(3 / 5), pytest.approx(2 / 3, abs=1e-6))
    assert whole["fingertips_mm"] == 0.4


def test_joints_take_order_and_the_couplings_of_the_other_model() -> None:
    grasps = plates_case().grasps
    other = dataclasses.replace(HAND, joint_names=HAND.joint_names[::-1], joint_body=HAND.joint_body[::-1].copy())
    moved = in_other_model(same_hand(HAND, other), grasps)
    assert moved.grasp.joint_positions == pytest.approx(grasps.grasp.joint_positions[:, ::-1])
    assert moved.grasp.hand_pose == pytest.approx(np.asarray(grasps.grasp.hand_pose), abs=1e-6)
