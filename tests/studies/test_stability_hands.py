"""The family of hands of the atlas is what it says, and what its map tells of few fingers."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.studies.stability import assets
from graspd.studies.stability.assets import Coupling, ring_hand
from graspd.worker.engines import backend
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel


def tips(hand: HandModel, joints: np.ndarray) -> np.ndarray:
    """(fingers, 3) origins of the last links."""
    poses = body_poses(hand, np.array([[0.0, 0, 0, 1, 0, 0, 0]]), joints[None])
    return np.array([poses[0, body, :3] for body, name in enumerate(hand.body_names) if name.endswith("_2")])


@pytest.mark.parametrize(
    ("coupling", "dofs"), [("each joint", 12), ("distal follows", 8), ("a drive a finger", 4), ("one drive", 1)]
)
def test_a_ring_has_as_many_dofs_as_its_drives(coupling: Coupling, dofs: int) -> None:
    assert ring_hand(4, coupling=coupling).dofs == dofs


def test_open_fingers_lean_outward_and_closed_ones_meet_above_the_palm() -> None:
    hand = ring_hand(3)
    wide, closed = (
        np.linalg.norm(tips(hand, hand.expand(posture))[:, :2], axis=1) for posture in (hand.lower, 0.5 * hand.upper)
    )
    assert (wide > 0.06).all()
    assert (closed < 0.03).all()


def test_a_hand_of_twice_the_size_reaches_twice_as_far() -> None:
    small, large = (ring_hand(3, size=size) for size in (1.0, 2.0))
    # The URDF has six decimals of a metre.
    np.testing.assert_allclose(
        tips(large, large.expand(large.lower)), 2 * tips(small, small.expand(small.lower)), atol=3e-6
    )


def test_the_distal_joint_turns_by_the_ratio_of_the_one_before_it() -> None:
    hand = ring_hand(2, coupling="distal follows", ratio=0.5)
    joints = hand.expand(np.full(hand.dofs, 0.6))
    by_name = dict(zip(hand.joint_names, joints, strict=True))
    assert by_name["joint_0_2"] == pytest.approx(0.5 * by_name["joint_0_1"])


def test_a_palm_without_fingers_is_refused_and_three_of_them_hold() -> None:
    backend.start()
    found = assets.hand_map(
        fingers=(0, 3), sizes=(), ratios=(), couplings=("distal follows",), fidelity="draft", count=4
    )
    by_fingers = {cell.x: cell for cell in found.cells}
    assert by_fingers[0].outcome == "refused"
    assert by_fingers[3].value > 0


def test_fingers_of_one_drive_hold_a_cube_between_them() -> None:
    backend.start()
    found = assets.hand_map(fingers=(3, 5), sizes=(), ratios=(), couplings=("one drive",), fidelity="draft", count=4)
    assert [cell.outcome for cell in found.cells] == ["good", "good"]
