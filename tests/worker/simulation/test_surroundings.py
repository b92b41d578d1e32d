"""Obstacles against closed forms, and against MuJoCo's distances."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import apply, quat_rotate
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.scenes.placement import MOST_PLANES, enclosing_solid
from graspd.worker.simulation.environment import CLEAR_M, Environment, Obstacle, PlacedGrasps
from graspd.worker.simulation.obstacles import FAR_M, PosedFeatures, body_clearance, obstacle_clearance
from tests.worker.models import piece, two_finger_hand, unit_vectors

TILTED = np.array([0.1, -0.2, 0.3, 0.8, 0.2, -0.4, 0.4])
TILTED[3:] /= np.linalg.norm(TILTED[3:])
UP = np.array([0.0, 0.0, 1.0])
BOX = Obstacle.box([0, 0, 0, 1, 0, 0, 0], [0.1, 0.1, 0.1])
R, L = 0.01, 0.06
EXACT = 2e-6  # float32 coordinates of 0.1 m, and the end of the search along an edge
EDGE, CORNER = np.sqrt(2), np.sqrt(3)
#: Turned by 45 degrees about y: a capsule points away from the edge at (0.05, y, 0.05), a box lies across it.
ACROSS = (np.cos(np.pi / 8), 0, np.sin(np.pi / 8), 0)


def test_distances_are_closed_forms_and_a_bound_beyond_edges() -> None:
    plane = Obstacle.half_space([0, 0, 2], 0.5)
    np.testing.assert_allclose(plane.distance(np.array([[1, 2, 3], [0, 0, 0.1]])), [2.75, -0.15], atol=1e-12)
    box = Obstacle.box([0, 0, 0, 1, 0, 0, 0], [0.2, 0.4, 0.6])
    points = np.array([[0.15, 0, 0], [0, -0.3, 0.1], [0, 0, 0.25], [0.09, 0, 0]])
    np.testing.assert_allclose(box.distance(points), [0.05, 0.1, -0.05, -0.01], atol=1e-12)
    box = Obstacle.box([0, 0, 0, 1, 0, 0, 0], [0.2, 0.2, 0.2])
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3))
    true = np.linalg.norm(np.maximum(np.abs(points) - 0.1, 0.0), axis=1)
    assert (box.distance(points)[true > 0] <= true[true > 0] + 1e-12).all()


def test_frames_keep_distances_and_up_is_against_gravity() -> None:
    points = np.random.default_rng(1).normal(size=(50, 3))
    for obstacle in (Obstacle.half_space([1, 2, 3], 0.4), Obstacle.box(TILTED, [0.3, 0.5, 0.7])):
        found = obstacle.in_frame(TILTED).distance(points)
        np.testing.assert_allclose(found, obstacle.distance(apply(TILTED, points)), atol=1e-12)
    placed = PlacedGrasps((Obstacle.half_space([0, 0, 1], 0),), TILTED[None], np.zeros(1, int))
    np.testing.assert_allclose(quat_rotate(TILTED[3:], placed.scenes[0].up), [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Obstacle.half_space([0, 0, 0], 1.0),
        lambda: Obstacle.half_space([0, 0, float("nan")], 1.0),
        lambda: Obstacle.box([0, 0, 0, 1, 0, 0, 0], [1, 0, 1]),
        lambda: Obstacle.box([0, 0, 0, 0, 0, 0, 0], [1, 1, 1]),
        lambda: Obstacle.box([0, 0, 0], [1, 1, 1]),
    ],
)
def test_nonsense_is_refused(make) -> None:
    with pytest.raises(InputError):
        make()


def random_postures(hand: HandModel, count: int, rng: np.random.Generator) -> Posture:
    turn = unit_vectors(rng, count, 4)
    pose = np.column_stack([rng.normal(size=(count, 3)) * 0.12, turn])
    return Posture(pose, hand.expand(rng.uniform(hand.lower, hand.upper, (count, hand.dofs))))


def test_only_fingertips_have_more_room_over_what_they_may_touch() -> None:
    hand = hand_from_path("barrett")
    posture = Posture(np.array([[0, 0, 0, 1.0, 0, 0, 0]]), hand.expand(hand.preshape[None]))
    table, wall = Obstacle.half_space([0, 0, 1], -0.3), Obstacle.half_space([1, 0, 0], -0.4)
    up = np.array([0.0, 0, 1])
    tips = np.isin(np.arange(hand.bodies), hand.fingertips)
    alone, beside = (body_clearance(hand, posture, [Environment((one,), up)])[0] for one in (table, wall))
    to_touch = replace(table, tips_m=-0.0005)
    found = body_clearance(hand, posture, [Environment((to_touch, wall), up)])[0]
    np.testing.assert_array_equal(found, np.minimum(alone + np.where(tips, 0.0025, 0.0), beside))
    assert obstacle_clearance(hand, posture, [Environment((to_touch, wall), up)])[0] == found.min()
    pose = np.array([0.1, 0, 0, 0.6, 0, 0.8, 0])
    assert to_touch.in_frame(pose).tips_m == -0.0005, "a support keeps what it says wherever it is seen from"


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_many_hands_have_the_room_of_each_ones_scene(name: str) -> None:
    """Against NumPy's features; both in double precision."""
    hand = hand_from_path(name)
    postures = random_postures(hand, 9, np.random.default_rng(4))
    one, other = Obstacle.half_space([0.3, -0.5, 0.8], -0.1), Obstacle.half_space([0, 1, 0], 0.05)
    up, which = np.array([0.0, 0, 1]), np.arange(9) % 3
    scenes = [Environment((one,), up), Environment((one, other), up), Environment((), up)]
    posed = PosedFeatures.create(hand, postures)
    wanted = np.full(9, np.inf)
    for number, around in enumerate([[one], [one, other], []]):
        for obstacle in around:
            wanted[which == number] = np.minimum(wanted, posed.distance(obstacle).min(axis=1))[which == number]
    np.testing.assert_allclose(obstacle_clearance(hand, postures, scenes, which), wanted, atol=1e-12)


def parted(hand: HandModel) -> tuple[HandModel, HandModel]:
    tip = [piece.body in hand.fingertips for piece in hand.pieces]
    return tuple(
        replace(hand, pieces=tuple(p for p, is_tip in zip(hand.pieces, tip, strict=True) if is_tip == wanted))
        for wanted in (True, False)
    )


def mujoco_room(hand, postures: Posture, obstacle: Obstacle) -> np.ndarray:
    """As `obstacle_clearance` has it, by MuJoCo's distances."""
    if obstacle.tips_m is None:
        return mujoco_distances(hand, postures, obstacle)
    tips, rest = parted(hand)
    over = mujoco_distances(tips, postures, obstacle) + CLEAR_M - obstacle.tips_m
    return np.minimum(mujoco_distances(rest, postures, obstacle), over)


def mujoco_distances(hand, postures: Posture, obstacle: Obstacle) -> np.ndarray:
    """(P,) least distance of a hand from an obstacle, by MuJoCo; at most 10 m."""
    from graspd.worker.scenes.neighbours import _add_piece

    spec = mujoco.MjSpec()
    if len(obstacle.corners):
        convex = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        spec.add_mesh(name="obstacle", inertia=convex, uservert=np.asarray(obstacle.corners, np.float32).ravel())
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="obstacle")
    else:
        geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])
        normal, offset = obstacle.planes[0, :3], obstacle.planes[0, 3]
        geom.pos = offset * normal
        mujoco.mju_quatZ2Vec(geom.quat, normal)
    for k, one in enumerate(hand.pieces):
        _add_piece(spec, spec.worldbody.add_body(mocap=True), f"p{k}", one)
    model = spec.compile()
    data = mujoco.MjData(model)
    bodies = body_poses(hand, postures.hand_pose, postures.joint_positions)
    least = []
    for row in bodies:
        placed = row[[one.body for one in hand.pieces]]
        data.mocap_pos[:], data.mocap_quat[:] = placed[:, :3], placed[:, 3:]
        mujoco.mj_kinematics(model, data)
        least.append(min(mujoco.mj_geomDistance(model, data, 0, k + 1, 10.0, None) for k in range(len(hand.pieces))))
    return np.array(least)


def link(kind: str) -> HandModel:
    """A hand of one piece about the origin of its root."""
    base = two_finger_hand()
    made = {
        "sphere": (trimesh.creation.icosphere(radius=R), (R,)),
        "capsule": (trimesh.creation.capsule(height=L, radius=R), (R, L)),
        "box": (trimesh.creation.box((L, 2 * R, 2 * R)), (L, 2 * R, 2 * R)),
        "hull": (trimesh.creation.box((L, 2 * R, 2 * R)), ()),
    }
    mesh, size = made[kind]
    return replace(base, digest=f"{hash(kind) & 0xFFFF:032x}", pieces=(piece(0, mesh, kind, size, (0, 0, 0)),))


def distance(kind: str, at: tuple[float, ...], obstacle: Obstacle, turn: tuple[float, ...] = (1, 0, 0, 0)) -> float:
    quaternion = np.array(turn, float) / np.linalg.norm(turn)
    posture = Posture(np.array([[*at, *quaternion]]), np.zeros((1, 2)))
    return float(obstacle_clearance(link(kind), posture, [Environment((obstacle,), UP)])[0])


@pytest.mark.parametrize(
    ("kind", "at", "turn", "expected"),
    [
        ("sphere", (0, 0, 0.08), (1, 0, 0, 0), 0.03 - R),
        ("sphere", (0.08, 0, 0.08), (1, 0, 0, 0), 0.03 * EDGE - R),
        ("sphere", (0.08, 0.08, 0.08), (1, 0, 0, 0), 0.03 * CORNER - R),
        ("sphere", (0, 0, 0.055), (1, 0, 0, 0), 0.005 - R),
        ("capsule", (0, 0, 0.11), (1, 0, 0, 0), 0.06 - L / 2 - R),
        ("capsule", (0.07, 0, 0.1), (1, 0, 0, 0), np.hypot(0.02, 0.05 - L / 2) - R),
        ("capsule", (0.09, 0, 0.09), ACROSS, 0.04 * EDGE - L / 2 - R),
        ("box", (0, 0, 0.08), (1, 0, 0, 0), 0.03 - R),
        ("box", (0.1, 0, 0.08), (1, 0, 0, 0), np.hypot(0.05 - L / 2, 0.03 - R)),
        ("box", (0.1, 0.08, 0.08), (1, 0, 0, 0), np.sqrt((0.05 - L / 2) ** 2 + 2 * (0.03 - R) ** 2)),
        ("box", (0.07, 0, 0.07), ACROSS, 0.02 * EDGE - R),
        ("hull", (0, 0, 0.08), (1, 0, 0, 0), 0.03 - R),
        ("hull", (0.07, 0, 0.07), ACROSS, 0.02 * EDGE - R),
    ],
)
def test_a_link_is_as_far_from_a_box_as_closed_forms_say(kind: str, at, turn, expected: float) -> None:
    assert distance(kind, at, BOX, turn) == pytest.approx(expected, abs=EXACT)
    below, reach = Obstacle.half_space(UP, 0.01), L / 2 + R if kind == "capsule" else R
    assert distance(kind, (0.3, 0.2, 0.07), below) == pytest.approx(0.06 - reach, abs=1e-12)


@pytest.mark.parametrize("kind", ["capsule", "box", "hull"])
def test_a_link_through_a_board_is_in_it(kind: str) -> None:
    """Neither the link's corners nor the board's edges are near; the link stands upright in the board's middle."""
    board = Obstacle.box([0, 0, 0, 1, 0, 0, 0], [1.0, 1.0, 0.01])
    turn = (1, 0, 0, 0) if kind == "capsule" else (np.sqrt(0.5), 0, np.sqrt(0.5), 0)
    depth = 0.005 + (R if kind == "capsule" else 0.0)
    assert distance(kind, (0, 0, 0), board, turn) == pytest.approx(-depth, abs=EXACT)
    assert distance(kind, (0, 0, 1.0), BOX) == pytest.approx(FAR_M), "what is far counts as far"


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_no_hand_is_nearer_to_a_solid_than_it_says_by_mujoco(name: str) -> None:
    """Exact for links that are boxes or round (1e-5 m: MuJoCo's meshes are float32 and converge to 1e-6); for hulls a
    lower bound."""
    hand, rng = hand_from_path(name), np.random.default_rng(2)
    solid, _ = enclosing_solid(rng.normal(size=(40, 3)) * [0.03, 0.05, 0.04])
    postures = random_postures(hand, 60, rng)
    found = obstacle_clearance(hand, postures, [Environment((solid,), UP)])
    true = mujoco_distances(hand, postures, solid)
    apart = true > 0
    assert (found[apart] <= true[apart] + 1e-5).all() and (found[~apart] < 1e-5).all()
    assert 10 < apart.sum() < 55
    if not any(one.kind == "hull" for one in hand.pieces):
        np.testing.assert_allclose(found[apart], np.minimum(true[apart], FAR_M), atol=1e-5)


def test_an_outer_solid_holds_its_points_and_is_a_box_of_a_box() -> None:
    points = 0.03 * unit_vectors(np.random.default_rng(0), 400)
    solid, error = enclosing_solid(points)
    assert len(solid.planes) <= MOST_PLANES and solid.distance(points).max() <= 1e-9
    radius = np.linalg.norm(solid.corners, axis=1).max()
    assert radius - 0.03 <= error < radius - 0.03 + 5e-4, "the ball's points are up to half a millimetre apart from it"
    # Euler: every edge of the solid is there.
    faces = sum((np.abs(solid.corners @ p[:3] - p[3]) < 1e-6).sum() >= 3 for p in solid.planes)
    assert len(solid.corners) - len(solid.edges) + faces == 2
    solid, error = enclosing_solid(np.asarray(trimesh.creation.box((0.1, 0.2, 0.3)).vertices))
    assert (len(solid.planes), len(solid.corners), len(solid.edges)) == (6, 8, 12)
    assert error == pytest.approx(0, abs=1e-9)
