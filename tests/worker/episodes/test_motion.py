"""Built-in arms, transits and timed motions: where the hand is, within which limits, and free of what."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import GraspdError
from graspd.service.model.transforms import (
    IDENTITY_POSE,
    apply,
    compose,
    pose_from_matrix,
    quat_from_axis_angle,
    quat_rotate,
)
from graspd.worker.episodes.episode import PHASES, EpisodeOutcome, Robot
from graspd.worker.episodes.execution import POSTURES, Executions, ToolFrame
from graspd.worker.episodes.motion import (
    CLEARANCES_M,
    FLYING_CHANGE_M,
    FLYING_HOME_M,
    NOMINAL_S,
    RESOLUTION,
    Motion,
    MotionPlanner,
    connect,
)
from graspd.worker.episodes.reach import BUILTIN_ARMS, NEAR_M, read_arm
from graspd.worker.episodes.robots import ADAPTER_M, read_robot
from graspd.worker.episodes.timing import MotionLimits
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.simulation.environment import Environment, Neighbour, Obstacle, Scenes
from graspd.worker.simulation.obstacles import obstacle_clearance
from graspd.worker.validation.decomposition import decompose
from tests.worker.models import object_from_mesh, two_finger_hand

#: DH parameters by joint: a, d, alpha [m, rad]. UR10e: standard; Panda: modified, with the flange as last row.
UR10E = [(0, 0.1807, np.pi / 2), (-0.6127, 0, 0), (-0.57155, 0, 0), (0, 0.17415, np.pi / 2), (0, 0.11985, -np.pi / 2)]
UR10E += [(0, 0.11655, 0)]
PANDA = [(0, 0.333, 0), (0, 0, -np.pi / 2), (0, 0.316, np.pi / 2), (0.0825, 0, np.pi / 2), (-0.0825, 0.384, -np.pi / 2)]
PANDA += [(0, 0, np.pi / 2), (0.088, 0, np.pi / 2), (0, 0.107, 0)]
HAND, CUBE = (
    replace(two_finger_hand(), velocity=np.full(2, 2.0)),
    object_from_mesh(trimesh.creation.box((0.04, 0.04, 0.04)), "cube"),
)
TABLE = Obstacle.half_space((0, 0, 1), 0.0)
ROBOTS = ["fly", "franka", "ur10e"]


def rotation(axis: str, angle: float) -> np.ndarray:
    c, s, made = np.cos(angle), np.sin(angle), np.eye(4)
    made[:3, :3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]] if axis == "z" else [[1, 0, 0], [0, c, -s], [0, s, c]]
    return made


def shift(x: float, z: float) -> np.ndarray:
    made = np.eye(4)
    made[[0, 2], 3] = x, z
    return made


def executions(supports: tuple[Obstacle, ...] = (TABLE,), count: int = 4, beside: Obstacle | None = None) -> Executions:
    """Grasps of a cube on a table from above, each in its own scene: another place, and turned by another angle.
    The neighbour `beside` stands in the scene of the second grasp, and below the tables in others."""
    places = np.array([(0.1 * np.cos(k), 0.15 * np.sin(2 * k), 0.02) for k in range(count)])
    object_pose = np.concatenate([places, np.tile([1.0, 0, 0, 0], (count, 1))], axis=1)
    yaw = quat_from_axis_angle(np.tile([0, 0, 1.0], (count, 1)), np.linspace(-1.5, 1.5, count))
    down = compose(np.concatenate([places, yaw], axis=1), np.array([0, 0, 0.075, 0, 1, 0, 0]))
    wide, closed = np.tile([-0.2, -0.2], (count, 1)), np.tile([0.1, 0.1], (count, 1))
    high = np.array([0, 0, 0.1, 0, 0, 0, 0])
    postures = [Posture(down + high, wide), Posture(down, wide), Posture(down, 0 * wide), Posture(down, closed)]
    postures += [Posture(down, closed + 0.1), Posture(down + high, closed + 0.1)]
    scenes = Scenes(supports, object_pose)
    if beside is not None:
        poses = np.tile([0, 0, -9.0, 1, 0, 0, 0], (count, 1, 1))
        poses[1, 0, :3] = middle = beside.corners.mean(axis=0)
        scenes = Scenes(supports, object_pose, (Neighbour(CUBE, (beside.corners - middle,), (), 0.0),), poses)
    placed = scenes.placed(np.arange(count))
    named = dict(zip(POSTURES, postures, strict=True))
    return Executions(
        HAND, CUBE, ToolFrame("palm", IDENTITY_POSE), "scene", 7 + np.arange(count), object_pose, named, placed, {}
    )


def robot_of(name: str, hand: HandModel = HAND) -> Robot:
    return read_robot(hand, None if name == "fly" else name)


def planner(name: str, found: Executions, robot: Robot | None = None) -> MotionPlanner:
    return MotionPlanner(robot or robot_of(name), found, decompose(CUBE))


@pytest.mark.parametrize("name", BUILTIN_ARMS)
def test_flange_of_a_built_in_arm_is_where_the_dh_parameters_have_it(name: str) -> None:
    arm = read_arm(name, None, IDENTITY_POSE)
    for q in np.random.default_rng(1).uniform(arm.model.lower, arm.model.upper, (20, arm.model.dofs)):
        wanted = np.eye(4)
        for k, (a, d, alpha) in enumerate(UR10E if name == "ur10e" else PANDA):
            turn = rotation("z", q[k] if k < len(q) else 0.0) @ shift(0, d)
            bend = shift(a, 0) @ rotation("x", alpha)
            wanted = wanted @ (turn @ bend if name == "ur10e" else bend @ turn)
        at = arm.root_pose(body_poses(arm.model, IDENTITY_POSE, arm.model.expand(q))[0, arm.mount_body])
        told = pose_from_matrix(wanted)
        assert at[:3] == pytest.approx(told[:3], abs=1e-12) and abs(at[3:] @ told[3:]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_motion_passes_the_postures_within_limits_of_velocity_and_acceleration(name: str) -> None:
    found, robot = executions(), robot_of(name)
    plan = planner(name, found)
    for row in range(len(found)):
        made = plan.plan(row)
        assert isinstance(made, Motion), made
        step = np.diff(made.time)
        assert (
            step == pytest.approx(0.02) and 3.9 < made.time[-1] < 6.0 and (np.diff(made.phase.astype(int)) >= 0).all()
        )
        ends = [int(np.flatnonzero(made.phase == k)[-1]) for k in range(len(PHASES))]
        poses = robot.poses(made.targets)[0][1][:, 0]
        for end, posture in zip(ends, (*POSTURES, "lift"), strict=True):
            wanted = found.postures[posture]
            assert np.linalg.norm(poses[end, :3] - wanted.hand_pose[row, :3]) < NEAR_M
            assert abs(poses[end, 3:] @ wanted.hand_pose[row, 3:]) > np.cos(1e-3)
            assert made.targets[end, -HAND.dofs :] == pytest.approx(wanted.joint_positions[row])
        # Between solutions of inverse kinematics, 5 mm apart, a spline of joints leaves the line by far less than 1 mm.
        straight = poses[ends[0] : ends[1] + 1, :2]
        assert np.abs(straight - found.postures["arrival"].hand_pose[row, :2]).max() < 5e-4
        # Differences are means of derivatives, so the limits hold without tolerance but rounding.
        limits = plan.limits
        velocity = limits.rates(np.diff(made.targets, axis=0)) / 0.02
        acceleration = limits.rates(np.diff(made.targets, 2, axis=0)) / 0.02**2
        assert (velocity <= limits.velocity * (1 + 1e-6)).all()
        assert (acceleration <= limits.acceleration * (1 + 1e-6)).all()
        for phase, end, seconds in zip(PHASES, ends, np.diff([0, *made.time[ends]]), strict=True):
            first = end - round(seconds / 0.02)
            # A phase that takes longer than its nominal duration is as fast as a limit allows.
            at_limit = (velocity[first:end] / limits.velocity).max() > 0.9
            assert seconds == pytest.approx(NOMINAL_S[phase]) or at_limit, phase
        if robot.arm is not None:
            split, tree = robot.arm.model.dofs, robot.arm.model
            assert limits.velocity[:split] == pytest.approx(tree.velocity)
            assert made.targets[0, :split] == pytest.approx(robot.arm.home)
            q = made.targets[:, :split]
            assert (q >= tree.lower - 1e-9).all() and (q <= tree.upper + 1e-9).all()
        else:
            palm = np.abs(poses[0, :3] - FLYING_HOME_M)
            assert (palm <= FLYING_CHANGE_M + 1e-9).all() and np.linalg.norm(
                made.targets[:, 3:7], axis=1
            ) == pytest.approx(1.0)
            assert quat_rotate(poses[0, 3:], np.array([0, 0, 1.0])) == pytest.approx([0, 0, -1.0], abs=1e-9)


@pytest.mark.parametrize(
    ("velocity", "acceleration", "seconds"),
    [(0.5, 1e3, 15 / 8 * 1.2 / 0.5), (1e3, 0.5, np.sqrt(10 / np.sqrt(3) * 1.2 / 0.5)), (1e3, 1e3, 1.0)],
)
def test_a_straight_motion_takes_the_time_of_minimum_jerk(velocity: float, acceleration: float, seconds: float) -> None:
    """Its extremes, with distance d in time T: 15/8 d/T, 10/sqrt(3) d/T^2 and 60 d/T^3."""
    limits = MotionLimits(np.full(2, velocity), np.full(2, acceleration), False)
    states = limits.timed(np.array([[0.0, 0.0], [1.2, 0.3]]), 1.0, 1e-3)
    assert len(states) * 1e-3 == pytest.approx(seconds, abs=2e-3)
    for order, peak in ((1, 15 / 8), (2, 10 / np.sqrt(3)), (3, 60)):
        found = np.abs(np.diff(states[:, 0], order)).max() / 1e-3**order
        # Differences of the jerk, which is largest at the ends, are means over three steps.
        assert found == pytest.approx(peak * 1.2 / seconds**order, rel=0.02)


def clearance(robot: Robot, states: np.ndarray, obstacle: Obstacle) -> float:
    """Least distance of the corners of a robot's pieces from an obstacle [m], without MuJoCo."""
    parts = [(tree, poses) for tree, poses in robot.poses(states)]
    return min(
        float(obstacle.distance(apply(poses[:, None, piece.body], piece.vertices)).min())
        for tree, poses in parts
        for piece in tree.pieces
        if tree is robot.hand or piece.body > 1  # base and shoulder stand on the table
    )


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("neighbour", [False, True])
def test_a_transit_goes_around_what_is_in_its_way(name: str, neighbour: bool) -> None:
    robot = robot_of(name)
    direct = planner(name, executions()).plan(1)
    states = direct.targets[direct.phase == 0]
    middle = robot.poses(states)[0][1][len(states) // 2, 0]
    block = Obstacle.box(np.array([*middle[:3], 1, 0, 0, 0]), [0.08, 0.08, 0.08])
    found = executions(beside=block) if neighbour else executions((TABLE, block))
    around = planner(name, found).plan(1)
    assert isinstance(around, Motion), around
    states = around.targets[around.phase == 0]
    # Between two tested postures, 0.01 s apart at full velocity, a point can come nearer than the clearance.
    assert clearance(robot, states, block) > 0.5 * CLEARANCES_M[0] and clearance(robot, states, TABLE) > 0
    hands = Posture(robot.poses(states)[0][1][:, 0], HAND.expand(states[:, -HAND.dofs :]))
    assert obstacle_clearance(HAND, hands, [Environment((block, TABLE), np.array([0, 0, 1.0]))]).min() > 0


@pytest.mark.parametrize("name", ROBOTS)
def test_a_motion_depends_on_the_seed_and_its_own_grasp_only(name: str) -> None:
    found = executions()
    whole, alone = planner(name, found), planner(name, found.take(np.array([2])))
    for row in range(3):
        last = whole.plan(row)
    assert isinstance(last, Motion)
    np.testing.assert_array_equal(last.targets, alone.plan(0).targets)


BOX = [
    Obstacle.box([*at, 1, 0, 0, 0], size)
    for at, size in [((-0.2, 0, 0.3), (0.02, 0.8, 0.6)), ((0.4, 0, 0.3), (0.02, 0.8, 0.6))]
]
BOX += [Obstacle.box([0.1, y, 0.3, 1, 0, 0, 0], [0.6, 0.02, 0.6]) for y in (-0.4, 0.4)]
LID = Obstacle.box([0.1, 0, 0.6, 1, 0, 0, 0], [0.6, 0.8, 0.02])


def narrowed(robot: Robot, found: Executions) -> Robot:
    """The robot with limits of 0.02 rad around its posture at the arrival of the first grasp."""
    made = planner("", found, robot).plan(0)
    q = made.targets[np.flatnonzero(made.phase == 1)[-1], : robot.arm.model.dofs]
    return replace(
        robot, arm=replace(robot.arm, model=replace(robot.arm.model, lower=q - 0.02, upper=q + 0.02), home=q)
    )


@pytest.mark.parametrize(
    ("name", "supports", "change", "outcome"),
    [
        ("fly", (TABLE, *BOX, LID), None, EpisodeOutcome.NO_TRANSIT),
        ("ur10e", (TABLE, *BOX, LID), None, EpisodeOutcome.COLLISION),
        # The hand at home is in a box.
        (
            "franka",
            (TABLE, Obstacle.box([-0.19, 0, 0.45, 1, 0, 0, 0], [0.06, 0.06, 0.06])),
            None,
            EpisodeOutcome.NO_TRANSIT,
        ),
        (
            "franka",
            (TABLE,),
            lambda robot: replace(robot, base=np.array([-2.0, 0, 0, 1, 0, 0, 0])),
            EpisodeOutcome.OUT_OF_REACH,
        ),
        ("franka", (TABLE,), lambda robot: narrowed(robot, executions()), EpisodeOutcome.NO_CONTINUOUS_MOTION),
    ],
)
def test_a_grasp_that_cannot_be_executed_has_a_reason(name, supports, change, outcome: EpisodeOutcome) -> None:
    robot = robot_of(name)
    assert planner(name, executions(supports), robot if change is None else change(robot)).plan(0) == outcome


def test_rrt_connect_finds_a_free_path_through_a_gap_and_none_out_of_a_cell() -> None:
    def is_free(q: np.ndarray, gap: float = 1.5) -> bool:
        return bool(abs(q[0]) > 0.1 or abs(q[1] - gap) < 0.3)

    ends, low, high = (np.array([-1.0, 0]), np.array([1.0, 0])), np.full(2, -2.0), np.full(2, 2.0)
    path = connect(*ends, low, high, is_free, np.random.default_rng(3))
    assert path is not None and len(path) >= 3
    np.testing.assert_array_equal(path[[0, -1]], ends)
    for a, b in pairwise(path):
        count = int(np.ceil(np.abs(b - a).max() / RESOLUTION))
        assert all(is_free(a + (b - a) * k / count) for k in range(count + 1))
    np.testing.assert_array_equal(path, connect(*ends, low, high, is_free, np.random.default_rng(3)))
    assert connect(*ends, low, high, lambda q: is_free(q, 9.0), np.random.default_rng(3)) is None


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow", "forearm"])
def test_a_hand_sits_on_the_flange_with_its_palm_or_forearm_along_z(name: str) -> None:
    if name == "forearm":
        # A copy of the hand beside its root serves as a forearm.
        side = np.array([0.2, 0, 0, 0, 0, 0, 0])
        aside = tuple(replace(p, vertices=p.vertices + side[:3], pose=p.pose + side) for p in HAND.pieces)
        hand = replace(HAND, mounting=replace(HAND, pieces=aside))
    else:
        hand = hand_from_path(name)
    robot = robot_of("ur10e", hand)
    state = np.concatenate([robot.arm.home, hand.preshape])
    (_, of_hand), (arm, of_arm) = robot.poses(state)
    flange = compose(of_arm[0, robot.arm.mount_body], robot.arm.mount_pose)
    z = quat_rotate(flange[3:], np.array([0, 0, 1.0]))
    added = [p for p in arm.pieces if p.body == robot.arm.mount_body][1:]  # the wrist itself is one cylinder
    if name == "forearm":
        assert len(added) == len(HAND.pieces)
        corners = np.concatenate([apply(of_arm[0, p.body], p.vertices) for p in added])
        assert quat_rotate(of_hand[0, 0, 3:], np.array([-1.0, 0, 0])) @ z > 0.95
    else:
        assert not added and quat_rotate(of_hand[0, 0, 3:], hand.palm.approach) @ z == pytest.approx(1.0)
        corners = np.concatenate([apply(of_hand[0, 0], p.vertices) for p in hand.pieces if p.body == 0])
    assert ((corners - flange[:3]) @ z).min() == pytest.approx(ADAPTER_M)


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"arm": "ur10"}, "neither a file nor a built-in arm (franka, ur10e); did you mean ur10e?"),
        ({"arm": "ur10e", "mount": "tool9"}, "has no link 'tool9' to mount a hand on"),
        ({"arm": "franka", "base": "1 2"}, "--base '1 2' is no pose"),
        ({"mount": "flange"}, "need an arm"),
    ],
)
def test_a_robot_that_cannot_be_is_refused_in_a_line(stated: dict, said: str) -> None:
    with pytest.raises(GraspdError) as told:
        read_robot(HAND, **stated)
    assert said in str(told.value) and "\n" not in str(told.value)
