"""Pregrasp and squeeze: clear of the object before, balanced and within the hand's strength when pressing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

from graspd.service.model.transforms import apply
from graspd.worker.control.opening import CLEARANCE_M, JAM_M, PALM_CLEARANCE_M
from graspd.worker.control.postures import STANDS_OFF_M, hold_forces, normal_force, pregrasp, squeeze, standing_off
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses, generalized_forces
from graspd.worker.hands.model import HandModel
from graspd.worker.quality.probe import Probe
from tests.worker.models import object_from_mesh, piece, two_finger_hand
from tests.worker.quality.helpers import plate_hand, posture

BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
PLATES = plate_hand()
CLOSED = posture(((0, 0, 0), (0.065, 0.065)))
#: Central differences of a smooth function at this step are good to its square.
STEP, DIFFERENCES = 1e-5, 1e-8


def rigid_plates() -> HandModel:
    """The plates with a drive that presses within its stroke."""
    return dataclasses.replace(PLATES, stiffness=np.full(2, 1000.0))


def coupled_hand() -> HandModel:
    """The two-finger hand with both joints driven by one dof: the right one half as fast."""
    return dataclasses.replace(
        two_finger_hand(),
        dof=np.array([-1, 0, 0], np.int32),
        multiplier=np.array([1.0, 1.0, 0.5]),
        offset=np.array([0, 0, 0.1]),
        dof_names=("grip",),
        lower=np.array([-0.3]),
        upper=np.array([1.2]),
        effort=np.ones(1),
        stiffness=np.full(1, 10.0),
        preshape=np.zeros(1),
        closing=np.ones(1),
    )


@pytest.mark.parametrize(
    "hand", [two_finger_hand(), coupled_hand(), plate_hand()], ids=["free", "coupled", "prismatic"]
)
def test_generalized_forces_are_the_gradient_of_work(hand: HandModel) -> None:
    rng = np.random.default_rng(0)
    q = rng.uniform(0.02, 0.09, hand.dofs)
    pose = np.array([0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5])
    body = np.array([1, 2, 2, 0])
    local, force = rng.normal(size=(4, 3)) * 0.05, rng.normal(size=(4, 1, 3))

    def points(at: np.ndarray) -> np.ndarray:
        return apply(body_poses(hand, pose, hand.expand(at))[0][body], local)

    bodies = body_poses(hand, pose, hand.expand(q))[0]
    found = generalized_forces(hand, bodies, body, points(q), force)[:, 0]
    for d in range(hand.dofs):
        move = STEP * np.eye(hand.dofs)[d]
        work = ((points(q + move) - points(q - move)) / (2 * STEP) * force[:, 0]).sum(axis=1)
        assert found[:, d] == pytest.approx(work, abs=DIFFERENCES)


def test_pregrasp_is_clear_and_within_limits() -> None:
    hand = two_finger_hand()
    held = posture(((0, 0, -0.095), (0.35, 0.35)), ((0.005, 0, -0.09), (0.25, 0.4)))
    before = pregrasp(hand, BOX, held)
    found = Probe(hand, BOX).measure(before)
    fingers = np.isin(Probe(hand, BOX).points.body, [1, 2])
    # Clearance is decided on 600 points; between them, a round finger's surface bulges by less than a millimetre.
    assert (found.distance[:, fingers].min(axis=1) > CLEARANCE_M - 1e-3).all()
    assert (found.distance.min(axis=1) > 0).all()
    assert (before.joint_positions >= hand.lower - 1e-12).all()
    assert (before.joint_positions < held.joint_positions).all()


def test_pregrasp_opens_no_further_than_it_must() -> None:
    hand = two_finger_hand()
    found = Probe(hand, BOX).measure(pregrasp(hand, BOX, posture(((0, 0, -0.095), (0.05, 0.05)))))
    fingers = np.isin(Probe(hand, BOX).points.body, [1, 2])
    # One step of 0.05 rad moves a tip at most 79 mm times that.
    assert found.distance[0, fingers].min() < CLEARANCE_M + 0.05 * 0.079


def test_pregrasp_backs_the_palm_away() -> None:
    hand = two_finger_hand()
    touching = posture(((0, 0, -0.025), (-0.2, -0.2)))
    before = pregrasp(hand, BOX, touching)
    assert before.hand_pose[0, 2] < touching.hand_pose[0, 2] - PALM_CLEARANCE_M
    assert before.hand_pose[0, :2] == pytest.approx([0, 0], abs=1e-12)


def test_fingers_leave_along_the_contact_normals() -> None:
    """Plates slide only along their normal: the way back must be the same line, each by its own dof."""
    before = pregrasp(PLATES, BOX, CLOSED)
    opened = (CLOSED.joint_positions - before.joint_positions)[0]
    assert opened[0] == pytest.approx(opened[1])
    # Gaps are closed to the next step of 50 mm, and clipped at the slide's end.
    assert (opened >= CLEARANCE_M).all()


def test_pregrasp_of_no_grasps_is_empty() -> None:
    none = Posture(np.zeros((0, 7)), np.zeros((0, 2)))
    assert len(pregrasp(two_finger_hand(), BOX, none)) == len(squeeze(two_finger_hand(), BOX, none)) == 0


def test_forces_on_a_box_between_plates_balance() -> None:
    held = hold_forces(plate_hand(), BOX, CLOSED, total_normal_force=20.0)
    assert held.residual[0] < 0.01
    assert held.torque[0] == pytest.approx([10.0, 10.0], rel=0.02)


def test_plates_press_with_the_stated_force() -> None:
    hand = rigid_plates()
    command = squeeze(hand, BOX, CLOSED, total_normal_force=20.0)
    pressed = (command.joint_positions - CLOSED.joint_positions) * hand.stiffness
    # Each plate carries half of the sum of normal forces, along its own slide.
    assert pressed[0] == pytest.approx([10.0, 10.0], rel=0.02)


def test_plates_are_not_told_to_go_beyond_their_stroke() -> None:
    # At 100 N/m the force would need a command 0.1 m behind the object: 35 mm are left.
    command = squeeze(plate_hand(), BOX, CLOSED, total_normal_force=20.0)
    assert command.joint_positions[0] == pytest.approx([0.1, 0.1])


def test_squeeze_never_asks_more_than_the_hand_can() -> None:
    weak = dataclasses.replace(rigid_plates(), effort=np.array([3.0, 5.0]))
    command = squeeze(weak, BOX, CLOSED, total_normal_force=200.0)
    pressed = (command.joint_positions - CLOSED.joint_positions) * weak.stiffness
    assert (np.abs(pressed) <= weak.effort + 1e-9).all()
    # All forces shrink together, so the plates still push against each other equally.
    assert pressed[0, 0] == pytest.approx(pressed[0, 1], rel=0.02)
    assert pressed[0, 0] == pytest.approx(3.0, rel=0.01)


def test_squeeze_respects_a_coupling() -> None:
    hand = coupled_hand()
    joints = hand.expand(np.array([[0.3]]))
    command = squeeze(hand, BOX, posture(((0, 0, -0.095), tuple(joints[0]))))
    moved = command.joint_positions - joints
    assert moved[0, 1] == pytest.approx(0.5 * moved[0, 0])


def test_one_sided_contact_cannot_be_balanced() -> None:
    held = hold_forces(plate_hand(), BOX, posture(((0, 0, 0), (0.065, 0.0))))
    assert held.residual[0] > 0.5


def test_squeeze_without_contact_is_the_grasp() -> None:
    away = posture(((0, 0, 1.0), (0.01, 0.01)))
    assert np.array_equal(squeeze(plate_hand(), BOX, away).joint_positions, away.joint_positions)


def test_a_grasp_s_postures_do_not_depend_on_its_companions() -> None:
    hand = two_finger_hand()
    several = posture(*(((0, 0, -0.095), (a, a)) for a in np.linspace(0.1, 0.4, 40)))
    alone = posture(((0, 0, -0.095), (0.4, 0.4)))
    for make in (pregrasp, squeeze):
        assert np.array_equal(make(hand, BOX, several).joint_positions[-1], make(hand, BOX, alone).joint_positions[0])


def test_a_finger_opens_no_farther_than_its_neighbour_lets_it() -> None:
    """Behind the left plate, 2 mm away, stands a wall that belongs to the right one; alone it would open by 4 mm."""
    wall = piece(2, trimesh.creation.box((0.03, 0.03, 0.01)), "box", (0.03, 0.03, 0.01), (0.0, 0.0, 0.082))
    hand = dataclasses.replace(PLATES, digest="walled", pieces=(*PLATES.pieces, wall))
    opened = (CLOSED.joint_positions - pregrasp(hand, BOX, CLOSED).joint_positions)[0]
    assert 0.0005 < opened[0] <= 0.002 + JAM_M
    free = (CLOSED.joint_positions - pregrasp(PLATES, BOX, CLOSED).joint_positions)[0]
    assert free[0] == pytest.approx(0.004)


def test_what_is_light_is_held_more_gently_and_what_is_heavy_more_firmly() -> None:
    forces = [normal_force(dataclasses.replace(BOX, mass=mass)) for mass in (0.02, 0.1, 0.5, 1.0)]
    assert forces == pytest.approx([10.0, 50.0, 50.0, 100.0])


def test_a_finger_stands_off_that_is_near_the_object_and_does_not_touch_it() -> None:
    # The left plate touches; the right one stands at distances around both limits.
    near, far = STANDS_OFF_M
    rights = np.array([0.0, near - 1e-3, near + 1e-3, far - 1e-3, far + 1e-3])
    grasps = Posture(
        np.repeat(CLOSED.hand_pose, len(rights), axis=0),
        np.stack([np.full(len(rights), 0.065), 0.065 - rights], axis=1),
    )
    assert standing_off(PLATES, BOX, grasps).tolist() == [False, False, True, True, False]
