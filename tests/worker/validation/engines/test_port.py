"""Parts of the port that pads do not show: couplings, tendons, turning joints, supports, lifts, saved states."""

from dataclasses import replace

import numpy as np
import pytest

from graspd.service.model.transforms import IDENTITY_POSE, Floats
from graspd.worker.hands.model import ConvexPiece, JointType
from graspd.worker.simulation.environment import Obstacle
from graspd.worker.validation.engines.port import Coupling, Drive, EngineModel, Link, RigidObject, Simulation
from graspd.worker.validation.engines.registry import ENGINES, load_engine

FRICTION = 0.6
FORCE = 2.0  # of each pad [N]
HALF_M = 0.02  # half of the cube's edge
PAD_M = 0.01  # thickness of a pad
ARM_M = 0.1  # from a turning joint to the middle of its pad
REACH_M = 0.005  # targets of the drives inside the cube: their pull is then at its limit
CORNERS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), float).reshape(3, -1).T
STILL = np.zeros(3)

#: MuJoCo has no adapter: it is part of the validator.
pytestmark = pytest.mark.parametrize("engine", ENGINES[1:], indirect=True)


def pad(side: int, *, turning: bool = False) -> Link:
    """A pad on the side -1 or +1 of the cube along x; a positive joint position presses it onto the cube."""
    arm = np.array([0, 0, -ARM_M]) if turning else np.zeros(3)
    place = np.array([side * (HALF_M + PAD_M / 2), 0, 0])
    pose = np.array([*-arm, 1, 0, 0, 0])
    size = (PAD_M, 0.02, 0.02)
    box = ConvexPiece(1, "box", size, pose, CORNERS * np.array(size) / 2 - arm, np.zeros((0, 3), np.int32), "pad")
    return Link(
        parent=0,
        joint=JointType.REVOLUTE if turning else JointType.PRISMATIC,
        origin=np.array([*(place + arm), 1, 0, 0, 0]),
        axis=np.array([0.0, -side, 0.0]) if turning else np.array([-side, 0.0, 0.0]),
        limits=(-1.0, 1.0) if turning else (-0.05, 0.05),
        damping=0.1 if turning else 20.0,
        armature=0.0,
        dry_friction=0.0,
        mass=0.05,
        centre=-arm,
        inertia=1e-5 * np.eye(3),
        pieces=(box,),
    )


def gripper(drives: tuple[Drive, ...], couplings: tuple[Coupling, ...] = (), *, turning: bool = False) -> EngineModel:
    root = Link(
        -1, JointType.FIXED, IDENTITY_POSE, np.array([0, 0, 1.0]), (0, 0), 0, 0, 0, 0.3, STILL, 1e-4 * np.eye(3), ()
    )
    links = root, pad(-1, turning=turning), pad(1, turning=turning)
    mass = 0.1
    cube = RigidObject((HALF_M * CORNERS,), mass, mass * (2 * HALF_M) ** 2 / 6 * np.eye(3), STILL)
    return EngineModel(links, drives, couplings, frozenset({(0, 1), (0, 2), (1, 2)}), cube, FRICTION, 0.0)


def drive(joint: int, gain: float = 1e4, effort: float = FORCE) -> Drive:
    return Drive((joint,), (1.0,), gain, effort)


def closed(engine: str, model: EngineModel, target: float = REACH_M) -> tuple[Simulation, Floats]:
    simulation, joints = load_engine(engine).simulation(model), np.array([0.0, target, target])
    simulation.reset(IDENTITY_POSE, IDENTITY_POSE, np.zeros(3))
    simulation.run(IDENTITY_POSE, joints, STILL, 0.4)
    return simulation, joints


def borne(engine: str, model: EngineModel, weight: float, target: float = REACH_M) -> float:
    """Return how far the cube falls within 1 s under a weight along -y [m]; the arms are stiff along y."""
    simulation, joints = closed(engine, model, target)
    simulation.run(IDENTITY_POSE, joints, np.array([0, -weight, 0]), 1.0)
    return -float(simulation.object_pose()[1])


def check_bears(engine: str, model: EngineModel, limit: float, target: float = REACH_M) -> None:
    """Check that the pads hold 95 % of a weight [N] and drop 105 %, which falls by 30 cm or more in 1 s."""
    assert borne(engine, model, 0.95 * limit, target) < 0.005
    assert borne(engine, model, 1.05 * limit, target) > 0.1


def test_a_turning_joint_presses_with_its_torque_over_its_arm(engine: str) -> None:
    drives = tuple(drive(joint, gain=100.0, effort=FORCE * ARM_M) for joint in (1, 2))
    check_bears(engine, gripper(drives, turning=True), 2 * FRICTION * FORCE, target=REACH_M / ARM_M)


def test_a_coupled_pad_shares_the_force_of_its_leader(engine: str) -> None:
    # Virtual work: F dx = N1 dx + N2 dx, and both pads press equally on a free cube.
    model = gripper((drive(1),), (Coupling(follower=2, leader=1, ratio=1.0, offset=0.0),))
    check_bears(engine, model, FRICTION * FORCE)


def test_each_joint_of_a_tendon_receives_its_full_pull(engine: str) -> None:
    model = gripper((Drive((1, 2), (1.0, 1.0), 1e3, FORCE),))
    check_bears(engine, model, 2 * FRICTION * FORCE)


@pytest.mark.parametrize("solid", [False, True])
def test_a_support_bears_the_object(engine: str, solid: bool) -> None:
    top = np.array([0, 0, -HALF_M - 0.1, 1, 0, 0, 0])
    ground = Obstacle.box(top, [0.4, 0.4, 0.2]) if solid else Obstacle.half_space([0, 0, 1], -HALF_M)
    open_hand = replace(gripper((drive(1), drive(2))), supports=(ground,))
    simulation, joints = closed(engine, open_hand, -0.02)
    simulation.run(IDENTITY_POSE, joints, np.array([0, 0, -1.0]), 1.0)
    assert np.abs(simulation.object_pose()[:3]).max() < 0.002


def test_the_root_lifts_the_object_and_a_restored_state_repeats_the_lift(engine: str) -> None:
    simulation, joints = closed(engine, gripper((drive(1), drive(2))))
    state, weight = simulation.save(), np.array([0, 0, -0.5 * FRICTION * FORCE])
    ends = []
    for _ in range(2):
        for share in np.linspace(0, 1, 51)[1:]:
            simulation.run(np.array([0, 0, 0.1 * share, 1, 0, 0, 0]), joints, weight, 0.016)
        ends.append(simulation.object_pose())
        simulation.restore(state)
    # The drive's stiffness lets the pads follow the cube; the cube moves little in the hand.
    assert np.abs(ends[0][:3] - [0, 0, 0.1]).max() < 0.005
    # PhysX has single precision, and a saved state lacks its contacts: the poses differ by 2e-6 there.
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=2e-5)
    assert np.abs(simulation.object_pose()[:3]).max() < 0.002
