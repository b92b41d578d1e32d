"""The squeeze of a gripper: both pads press with what its drive can, in the validator's engine as on paper."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import trimesh

from graspd.worker.control.postures import pregrasp, squeeze
from graspd.worker.grasps import Posture
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import MujocoOptions, build
from tests.worker.hands.grippers import gripper
from tests.worker.models import object_from_mesh

BALL = object_from_mesh(trimesh.creation.icosphere(4, 0.02))
#: The pads stand 0.5 mm off each side of the ball, as a planner leaves them. Housing below, ball between the fingers.
GAP = 5e-4
AT = np.array([[0, 0, -0.09, 1, 0, 0, 0]])


def grasp_of(hand: HandModel) -> Posture:
    return Posture(AT, hand.expand(np.full((1, hand.dofs), 0.02 + GAP)))


def pad_forces(hand: HandModel, obj: ObjectModel, grasp: Posture) -> list[float]:
    """Normal force at each pad [N] after the hand has pressed for three seconds."""
    scene = build(hand, obj, decompose(obj), MujocoOptions())
    data = mujoco.MjData(scene.model)
    scene.place(data, grasp.hand_pose[0], grasp.joint_positions[0])
    pressed = squeeze(hand, obj, grasp)
    scene.command(data, pressed.hand_pose[0], pressed.joint_positions[0])
    mujoco.mj_step(scene.model, data, nstep=round(3.0 / scene.physics.timestep))
    forces, out = {1: 0.0, 2: 0.0}, np.zeros(6)
    for i in range(data.ncon):
        bodies = {scene.model.body(scene.model.geom_bodyid[geom]).name for geom in data.contact[i].geom}
        mujoco.mj_contactForce(scene.model, data, i, out)
        for body in forces:
            forces[body] += out[0] if f"body{body}" in bodies else 0.0
    return list(forces.values())


@pytest.mark.parametrize(
    ("coupled", "effort", "each"),
    [(True, 20.0, 10.0), (False, 20.0, 20.0), (False, 100.0, 25.0)],
    ids=["one drive shares its limit", "two drives", "no more than is asked for"],
)
def test_pads_press_with_the_limit_of_their_drive(coupled: bool, effort: float, each: float) -> None:
    hand = gripper(coupled=coupled, effort=effort)
    # A drive that stalls presses with its limit, to within a hundredth when contacts have come to rest. Drives that
    # follow a position lose what contacts give way: up to 2 mm under 25 N, at a gain of 2 N/mm.
    low = 0.98 * each if coupled else each - 4.0
    for force in pad_forces(hand, BALL, grasp_of(hand)):
        assert low <= force <= 1.02 * each


def test_a_squeeze_stays_within_the_stroke() -> None:
    hand = gripper()
    thin = object_from_mesh(trimesh.creation.box((0.004, 0.02, 0.03)))
    grasp = Posture(AT, hand.expand(np.full((1, 1), 0.002 + GAP)))
    assert squeeze(hand, thin, grasp).joint_positions.min() >= 0.0


def test_both_jaws_open_for_the_way_in() -> None:
    for coupled in (True, False):
        hand = gripper(coupled=coupled)
        opened = pregrasp(hand, BALL, grasp_of(hand)).joint_positions[0]
        # At least 3 mm clear of the object, as seen by points on the pads, in steps of 2 mm.
        assert opened.min() >= 0.0225
        assert opened.max() <= 0.026


def test_a_flat_pad_touches_a_flat_side_at_several_points() -> None:
    """At one point each a box turns about the line between them: what a flat pad is made to prevent."""
    box = object_from_mesh(trimesh.creation.box((0.04, 0.05, 0.03)))
    hand = gripper()
    scene = build(hand, box, decompose(box), MujocoOptions())
    data = mujoco.MjData(scene.model)
    scene.place(data, AT[0], hand.expand(np.full((1, 1), 0.02 - 1e-4))[0])
    mujoco.mj_forward(scene.model, data)
    touching = [sorted(data.contact[i].geom) for i in range(data.ncon) if data.contact[i].dist < 0]
    assert all(touching.count(pair) >= 3 for pair in touching) and len({tuple(pair) for pair in touching}) == 2
