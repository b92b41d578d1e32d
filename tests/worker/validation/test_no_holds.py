"""What others may call a hold and the six pushes must not: a hand without its thumb, an object in the open palm."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graspd.exchange.inputs import load_case
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.validation.validator import validate

THUMB = ("joint_12.0", "joint_13.0", "joint_14.0", "joint_15.0")


def test_a_published_grasp_without_its_thumb_is_refused_with_a_reason(shared_data: Path) -> None:
    case = load_case(shared_data / "reference_grasps" / "frogger_allegro" / "056_tennis_ball.json")
    some = case.grasps.take(np.arange(3))
    thumb = np.array([name in THUMB for name in case.hand.joint_names])
    away = some.pregrasp.joint_positions - 0.3

    def opened(posture: Posture) -> Posture:
        return Posture(posture.hand_pose, np.where(thumb, away, posture.joint_positions))

    without = GraspSet(opened(some.grasp), opened(some.pregrasp), opened(some.squeeze), some.stability_loss)
    whole, found = (validate(case.hand, case.obj, grasps) for grasps in (some, without))
    assert whole.success.all() and not found.success.any()
    assert all(reason.startswith(("rotated", "displaced", "lost")) for reason in found.reasons)


def test_an_object_that_lies_in_the_open_palm_is_pushed_out_of_it() -> None:
    hand, obj = hand_from_path("allegro"), object_from_path("block")
    half = hand.palm.approach + np.array([0.0, 0, 1])
    half = half / np.linalg.norm(half) if np.linalg.norm(half) > 1e-6 else np.array([1.0, 0, 0])
    turn = np.array([0.0, *half])  # half a turn about the middle of approach and up
    rotation = 2 * np.outer(half, half) - np.eye(3)
    below = np.array([*obj.centre_of_mass[:2], obj.vertices[:, 2].min() - 0.001])
    pose = np.array([[*(below - rotation @ hand.palm.centre), *turn]])
    flat = Posture(pose, hand.expand(np.clip(np.zeros(hand.dofs), hand.lower, hand.upper)[None]))
    found = validate(hand, obj, GraspSet(flat, flat, flat, np.full(1, np.nan)))
    assert not found.success.any() and found.reasons[0] != "penetration"
