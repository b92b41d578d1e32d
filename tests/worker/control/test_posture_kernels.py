"""The kernels that open hands and balance forces against NumPy, one grasp after the other."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.transforms import quat_rotate
from graspd.worker.control.postures import CLOSING_M, hold_forces, pregrasp, squeeze, touching_links
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.quality.contact import LINK_CONTACT_M
from graspd.worker.quality.probe import Probe
from tests.worker.control import postures_reference as reference

OBJ = object_from_path("mug", face_error_m=0.002)
#: Room for the single precision of distances, which weigh the ways of fingers [rad and m].
SINGLE = 1e-6


def around(hand: HandModel, count: int) -> Posture:
    """Half closed hands around the object: clear ones, touching ones, deep ones."""
    rng = np.random.default_rng(5)
    rotation = rng.normal(size=(count, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    back = quat_rotate(rotation, hand.palm.approach) * rng.uniform(0.02, 0.08, (count, 1))
    root = OBJ.centre_of_mass - back - quat_rotate(rotation, hand.palm.centre)
    q = hand.preshape + rng.uniform(0.0, 0.5, (count, hand.dofs)) * hand.closing * hand.span
    return Posture(np.concatenate([root, rotation], axis=1), hand.expand(np.clip(q, hand.lower, hand.upper)))


@pytest.fixture(scope="module", params=["allegro", "barrett"])
def case(request: pytest.FixtureRequest) -> tuple[HandModel, Probe, Posture]:
    hand = hand_from_path(request.param)
    return hand, Probe(hand, OBJ, hand_points=600, object_points=64), around(hand, 24)


def test_hands_open_as_in_numpy(case: tuple[HandModel, Probe, Posture]) -> None:
    hand, probe, grasp = case
    found, wanted = pregrasp(hand, OBJ, grasp), reference.pregrasp(probe, grasp)
    np.testing.assert_allclose(found.joint_positions, wanted.joint_positions, atol=SINGLE)
    np.testing.assert_allclose(found.hand_pose, wanted.hand_pose, atol=1e-12)
    moved = np.abs(found.joint_positions - grasp.joint_positions).max(axis=1) > 0.01
    retreated = np.linalg.norm((found.hand_pose - grasp.hand_pose)[:, :3], axis=1) > 0
    assert moved.sum() > 0
    assert 0 < retreated.sum() < len(grasp)


def test_forces_balance_as_in_numpy(case: tuple[HandModel, Probe, Posture]) -> None:
    hand, probe, grasp = case
    held = hold_forces(hand, OBJ, grasp, total_normal_force=20.0, friction=0.3)
    wanted = reference.balanced(probe, grasp, total_normal_force=20.0, friction=0.3)
    # Both least squares are exact but for rounding: see test_balance.
    np.testing.assert_allclose(held.residual, [residual for residual, _ in wanted], atol=1e-8)
    np.testing.assert_allclose(held.torque, [torque for _, torque in wanted], atol=1e-7)
    assert 0 < np.count_nonzero(held.residual < 1.0) < len(grasp)


def test_fingers_that_stand_off_are_commanded_to_close_as_in_numpy(case: tuple[HandModel, Probe, Posture]) -> None:
    hand, probe, grasp = case
    wanted = reference.balanced(probe, grasp, total_normal_force=20.0, friction=0.3, closing=CLOSING_M)
    near = reference.balanced(probe, grasp, total_normal_force=20.0, friction=0.3)
    command = squeeze(hand, OBJ, grasp, total_normal_force=20.0, friction=0.3)
    pressed = (hand.reduce(command.joint_positions) - hand.reduce(grasp.joint_positions)) * hand.stiffness
    np.testing.assert_allclose(pressed, [torque for _, torque in wanted], atol=1e-7)
    assert any(np.abs(a - b).max() > 1e-3 for (_, a), (_, b) in zip(near, wanted, strict=True))


def test_links_in_contact_are_counted_as_in_numpy(case: tuple[HandModel, Probe, Posture]) -> None:
    hand, probe, grasp = case
    near = probe.touch(grasp, reach=LINK_CONTACT_M).distance < LINK_CONTACT_M
    wanted = [len(np.unique(probe.points.body[one])) for one in near]
    assert touching_links(hand, OBJ, grasp).tolist() == wanted
    assert len(set(wanted)) > 2
