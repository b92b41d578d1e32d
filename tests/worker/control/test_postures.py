"""Pregrasp and squeeze: clear of the object before, balanced and within the hand's strength when pressing."""

import dataclasses

import mujoco
import numpy as np
import pytest
import trimesh
import warp as wp

from graspd.service.model.transforms import apply, quat_rotate
from graspd.worker.control import opening, postures
from graspd.worker.control import squeeze as squeezing
from graspd.worker.control.postures import hold_forces, normal_force, pregrasp, squeeze
from graspd.worker.control.squeeze import solve_nonnegative
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses, generalized_forces
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.quality.contact import LINK_CONTACT_M
from graspd.worker.quality.posed import posture_data_of
from graspd.worker.quality.probe import Probe
from graspd.worker.simulation.environment import Obstacle, PlacedGrasps
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import MujocoOptions, build_scene
from tests.worker.hands.urdfs import gripper
from tests.worker.models import object_from_mesh, on_one_dof, piece, two_finger_hand
from tests.worker.quality.helpers import placed_data, plate_hand, posture

BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
PLATES = plate_hand()
CLOSED = posture(((0, 0, 0), (0.065, 0.065)))
#: Central differences of a smooth function at this step are good to its square.
STEP, DIFFERENCES = 1e-5, 1e-8
OBJ = object_from_path("mug", face_error_m=0.002)
#: Room for the single precision of distances, which weigh the ways of fingers [rad and m].
SINGLE = 1e-6
BALL = object_from_mesh(trimesh.creation.icosphere(4, 0.02))
#: The pads stand 0.5 mm off each side of the ball, as a planner leaves them. Housing below, ball between the fingers.
GAP = 5e-4
AT = np.array([[0, 0, -0.09, 1, 0, 0, 0]])
TARGET = 10.0 * np.eye(23)[6]


def rigid_plates() -> HandModel:
    return dataclasses.replace(PLATES, stiffness=np.full(2, 1000.0))


@pytest.mark.parametrize(
    "hand",
    [two_finger_hand(), on_one_dof(two_finger_hand(), 0.5, 0.1), plate_hand()],
    ids=["free", "coupled", "prismatic"],
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


def test_pregrasp_is_clear_within_limits_and_no_farther_than_it_must() -> None:
    hand = two_finger_hand()
    held = posture(((0, 0, -0.095), (0.35, 0.35)), ((0.005, 0, -0.09), (0.25, 0.4)))
    before = pregrasp(hand, BOX, held)
    found = Probe(hand, BOX).measure(before)
    fingers = np.isin(Probe(hand, BOX).points.body, [1, 2])
    # Clearance is decided on 600 points; between them, a round finger's surface bulges by less than a millimetre.
    assert (found.distance[:, fingers].min(axis=1) > opening.CLEARANCE_M - 1e-3).all()
    assert (found.distance.min(axis=1) > 0).all() and (before.joint_positions >= hand.lower - 1e-12).all()
    assert (before.joint_positions < held.joint_positions).all()
    found = Probe(hand, BOX).measure(pregrasp(hand, BOX, posture(((0, 0, -0.095), (0.05, 0.05)))))
    # One step of 0.05 rad moves a tip at most 79 mm times that.
    assert found.distance[0, fingers].min() < opening.CLEARANCE_M + 0.05 * 0.079
    touching = posture(((0, 0, -0.025), (-0.2, -0.2)))
    before = pregrasp(hand, BOX, touching)
    assert before.hand_pose[0, 2] < touching.hand_pose[0, 2] - opening.PALM_CLEARANCE_M
    assert before.hand_pose[0, :2] == pytest.approx([0, 0], abs=1e-12)


def test_fingers_leave_along_the_contact_normals() -> None:
    """Plates slide only along their normal: the way back must be the same line, each by its own dof."""
    opened = (CLOSED.joint_positions - pregrasp(PLATES, BOX, CLOSED).joint_positions)[0]
    assert opened[0] == pytest.approx(opened[1])
    # Gaps are closed to the next step of 50 mm, and clipped at the slide's end.
    assert (opened >= opening.CLEARANCE_M).all()


def test_forces_between_plates_balance_one_sided_ones_do_not() -> None:
    held = hold_forces(plate_hand(), BOX, CLOSED, total_normal_force=20.0)
    assert held.residual[0] < 0.01 and held.torque[0] == pytest.approx([10.0, 10.0], rel=0.02)
    held = hold_forces(plate_hand(), BOX, posture(((0, 0, 0), (0.065, 0.0))))
    assert held.residual[0] > 0.5


def test_plates_press_with_the_stated_force_within_their_stroke() -> None:
    hand = rigid_plates()
    command = squeeze(hand, BOX, CLOSED, total_normal_force=20.0)
    pressed = (command.joint_positions - CLOSED.joint_positions) * hand.stiffness
    # Each plate carries half of the sum of normal forces, along its own slide.
    assert pressed[0] == pytest.approx([10.0, 10.0], rel=0.02)
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


def test_squeeze_respects_a_coupling_and_without_contact_is_the_grasp() -> None:
    hand = on_one_dof(two_finger_hand(), 0.5, 0.1)
    joints = hand.expand(np.array([[0.3]]))
    moved = squeeze(hand, BOX, posture(((0, 0, -0.095), tuple(joints[0])))).joint_positions - joints
    assert moved[0, 1] == pytest.approx(0.5 * moved[0, 0])
    away = posture(((0, 0, 1.0), (0.01, 0.01)))
    assert np.array_equal(squeeze(plate_hand(), BOX, away).joint_positions, away.joint_positions)
    none = Posture(np.zeros((0, 7)), np.zeros((0, 2)))
    assert len(pregrasp(two_finger_hand(), BOX, none)) == len(squeeze(two_finger_hand(), BOX, none)) == 0


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
    assert 0.0005 < opened[0] <= 0.002 + opening.JAM_M
    free = (CLOSED.joint_positions - pregrasp(PLATES, BOX, CLOSED).joint_positions)[0]
    assert free[0] == pytest.approx(0.004)


def test_what_is_light_is_held_gently_what_is_heavy_firmly() -> None:
    forces = [normal_force(dataclasses.replace(BOX, mass=mass)) for mass in (0.001, 0.02, 0.1, 0.5, 1.0)]
    assert forces == pytest.approx([2.0, 10.0, 50.0, 50.0, 100.0])


def test_a_finger_stands_off_that_is_near_and_does_not_touch() -> None:
    # The left plate touches; the right one stands at distances around both limits.
    near, far = postures.STANDS_OFF_M
    rights = np.array([0.0, near - 1e-3, near + 1e-3, far - 1e-3, far + 1e-3])
    grasps = posture(*(((0, 0, 0), (0.065, 0.065 - right)) for right in rights))
    assert postures.fingers_off_object(PLATES, BOX, grasps).tolist() == [False, False, True, True, False]


def test_a_finger_without_sampled_points_counts_as_far() -> None:
    hand = hand_from_path("allegro")
    gaps = posture_data_of(hand, OBJ, points=2, device="cpu").finger_gaps(around(hand, 3), 0.03)
    assert gaps.shape == (3, 4) and (gaps == 0.03).all(axis=0).any()


def around(hand: HandModel, count: int) -> Posture:
    rng = np.random.default_rng(5)
    rotation = rng.normal(size=(count, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    back = quat_rotate(rotation, hand.palm.approach) * rng.uniform(0.02, 0.08, (count, 1))
    root = OBJ.centre_of_mass - back - quat_rotate(rotation, hand.palm.centre)
    q = hand.preshape + rng.uniform(0.0, 0.5, (count, hand.dofs)) * hand.closing * hand.span
    return Posture(np.concatenate([root, rotation], axis=1), hand.expand(np.clip(q, hand.lower, hand.upper)))


def above(plane: Obstacle, count: int) -> PlacedGrasps:
    return PlacedGrasps((plane,), np.array([[0, 0, 0, 1.0, 0, 0, 0]]), np.zeros(count, np.intp))


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_a_finger_that_stands_off_closes_until_it_touches(name: str) -> None:
    """It keeps its posture if it would meet another finger first, or move deeper into an obstacle."""
    hand = hand_from_path(name)
    grasps, (near, far), finger = around(hand, 60), postures.STANDS_OFF_M, opening.fingers_of_dofs(hand)
    posing = posture_data_of(hand, OBJ, points=600, device="cpu")
    gaps = posing.finger_gaps(grasps, 0.1)
    closed = postures.close_fingers(hand, OBJ, grasps, above(Obstacle.half_space([0, 0, 1], -2.0), 60))
    moved = hand.reduce(closed.joint_positions) - hand.reduce(grasps.joint_positions)
    fingers = np.stack([(moved[:, finger == f] != 0).any(axis=1) for f in range(gaps.shape[1])], axis=1)
    after = posing.finger_gaps(closed, 0.1)
    assert fingers.sum() > 10 and not (fingers & ~((gaps > near) & (gaps < far))).any()
    assert (after[fingers] < near).all() and np.median(after[fingers]) == pytest.approx(postures.CLOSED_M, abs=5e-4)
    assert (moved * hand.closing >= 0).all()
    inside = postures.close_fingers(hand, OBJ, grasps, above(Obstacle.half_space([0, 0, 1], 1.0), 60))
    down = (inside.joint_positions != grasps.joint_positions).any(axis=1)
    assert down.sum() < (moved != 0).any(axis=1).sum()


@pytest.fixture(scope="module", params=["allegro", "barrett"])
def case(request: pytest.FixtureRequest) -> tuple[HandModel, Probe, Posture]:
    hand = hand_from_path(request.param)
    return hand, Probe(hand, OBJ, hand_points=600, object_points=64), around(hand, 24)


def test_real_hands_open_retreat_and_press_with_balanced_forces(case: tuple[HandModel, Probe, Posture]) -> None:
    hand, probe, grasp = case
    posing = posture_data_of(hand, OBJ, points=600, device="cpu")
    found = pregrasp(hand, OBJ, grasp)
    moved = np.abs(found.joint_positions - grasp.joint_positions).max(axis=1) > 0.01
    back = (found.hand_pose - grasp.hand_pose)[:, :3]
    retreated = np.linalg.norm(back, axis=1) > 0
    assert moved.any() and 0 < retreated.sum() < len(grasp)
    approach = quat_rotate(grasp.hand_pose[:, 3:], hand.palm.approach)
    np.testing.assert_allclose(back, (back * approach).sum(axis=1, keepdims=True) * approach, atol=1e-12)
    before, after = (posing.finger_gaps(each, opening.CLEARANCE_M) for each in (grasp, found))
    print(
        (after - before)[~retreated].min(),
        (before < 1e-3).sum(),
        (after[~retreated] >= opening.CLEARANCE_M - 1e-6).mean(),
    )
    held = hold_forces(hand, OBJ, grasp, total_normal_force=20.0, friction=0.3)
    assert 0 < np.count_nonzero(held.residual < 1.0) < len(grasp)
    assert (np.abs(held.torque) <= hand.effort + 1e-9).all() and np.abs(held.torque).max() > 0.5
    near = probe.nearest_points(grasp, reach=LINK_CONTACT_M).distance < LINK_CONTACT_M
    links = [len(np.unique(probe.points.body[one])) for one in near]
    assert postures.touching_links(hand, OBJ, grasp).tolist() == links and len(set(links)) > 2


def grasp_of(hand: HandModel) -> Posture:
    return Posture(AT, hand.expand(np.full((1, hand.dofs), 0.02 + GAP)))


def pad_forces(hand: HandModel, obj: ObjectModel, grasp: Posture) -> list[float]:
    """Normal force at each pad [N] after the hand has pressed for three seconds."""
    scene = build_scene(hand, obj, decompose(obj), MujocoOptions())
    data = placed_data(scene, grasp.joint_positions[0], grasp.hand_pose[0])
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


def test_gripper_opens_for_way_in_and_squeezes_within_its_stroke() -> None:
    for coupled in (True, False):
        hand = gripper(coupled=coupled)
        opened = pregrasp(hand, BALL, grasp_of(hand)).joint_positions[0]
        # At least 3 mm clear of the object, as seen by points on the pads, in steps of 2 mm.
        assert opened.min() >= 0.0225 and opened.max() <= 0.026
    hand = gripper()
    thin = object_from_mesh(trimesh.creation.box((0.004, 0.02, 0.03)))
    grasp = Posture(AT, hand.expand(np.full((1, 1), 0.002 + GAP)))
    assert squeeze(hand, thin, grasp).joint_positions.min() >= 0.0


def nonnegative_weights(matrix: np.ndarray, count: np.ndarray) -> np.ndarray:
    """`solve_nonnegative` of systems (B, K, 23) for `TARGET` with a ridge of 0.1."""
    given = [wp.array(a, dtype=kind, device="cpu") for a, kind in ((matrix, wp.float64), (count, wp.int32))]
    return np.array(solve_nonnegative(given[0], TARGET, 0.1, given[1]).numpy())


def systems(count: int, columns: int, seed: int) -> np.ndarray:
    """(B, K, 23) like those of forces: a wrench of order one, a heavy row of the sum, light torques."""
    rng = np.random.default_rng(seed)
    made = rng.normal(size=(count, columns, 23))
    made[..., :6] += rng.normal(size=(count, 1, 6))
    made[..., 6] = 10.0
    made[..., 7:] *= 0.05
    return made


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("columns", [8, 32, 128])
def test_weights_are_scipy_s(columns: int, seed: int) -> None:
    made = systems(16, columns, seed)
    count = np.random.default_rng(seed).integers(1, columns + 1, 16)
    found = nonnegative_weights(made, count)
    wanted = [squeezing._solve_by_scipy(made[b], TARGET, 0.1, int(count[b])) for b in range(16)]
    # Both are exact but for rounding; the normal equations square the condition, some 1e5 here.
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_the_kernel_needs_no_second_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(squeezing, "_solve_by_scipy", None)
    nonnegative_weights(systems(64, 96, 9), np.full(64, 96))


def test_weights_keep_to_their_columns_and_leave_out_the_worse() -> None:
    made = np.zeros((1, 2, 23))
    made[0, 0, 6], made[0, 1, 6] = 10.0, -10.0
    found = nonnegative_weights(made, np.array([2]))
    # min (10 x - 10)^2 + 0.01 x^2
    np.testing.assert_allclose(found, [[100 / 100.01, 0.0]], rtol=1e-12)
    made = systems(3, 40, 1)
    made[:, 20:] = np.nan
    found = nonnegative_weights(made, np.full(3, 20))
    assert np.isfinite(found).all() and not found[:, 20:].any()
