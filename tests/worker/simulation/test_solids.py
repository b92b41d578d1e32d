"""Distances of links from solid obstacles: closed forms, MuJoCo's, and what pierces a thin board."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import trimesh

from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.scenes.placement import MOST_PLANES, outer_solid
from graspd.worker.simulation.environment import Environment, Obstacle
from graspd.worker.simulation.obstacles import FAR_M, obstacle_distances
from tests.worker.models import piece, two_finger_hand

UP = np.array([0.0, 0.0, 1.0])
BOX = Obstacle.box([0, 0, 0, 1, 0, 0, 0], [0.1, 0.1, 0.1])
R, L = 0.01, 0.06
#: float32 coordinates of 0.1 m, and the end of the search along an edge.
EXACT = 2e-6


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
    fields = {name: getattr(base, name) for name in base.__dataclass_fields__}
    return HandModel(
        **{**fields, "digest": f"{hash(kind) & 0xFFFF:032x}", "pieces": (piece(0, mesh, kind, size, (0, 0, 0)),)}
    )


def distance(kind: str, at: tuple[float, ...], obstacle: Obstacle, turn: tuple[float, ...] = (1, 0, 0, 0)) -> float:
    quaternion = np.array(turn, float) / np.linalg.norm(turn)
    posture = Posture(np.array([[*at, *quaternion]]), np.zeros((1, 2)))
    return float(obstacle_distances(link(kind), posture, Environment((obstacle,), UP))[0])


EDGE, CORNER = np.sqrt(2), np.sqrt(3)
#: Turned by 45 degrees about y: a capsule points away from the edge at (0.05, y, 0.05), a box lies across it.
ACROSS = (np.cos(np.pi / 8), 0, np.sin(np.pi / 8), 0)


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


@pytest.mark.parametrize(("kind", "reach"), [("sphere", R), ("capsule", L / 2 + R), ("box", R), ("hull", R)])
def test_a_link_is_as_far_from_a_half_space_as_closed_forms_say(kind: str, reach: float) -> None:
    assert distance(kind, (0.3, 0.2, 0.07), Obstacle.half_space(UP, 0.01)) == pytest.approx(0.06 - reach, abs=1e-12)


@pytest.mark.parametrize("kind", ["capsule", "box", "hull"])
def test_a_link_through_a_board_is_in_it(kind: str) -> None:
    """Neither the link's corners nor the board's edges are near; the link stands upright in the board's middle."""
    board = Obstacle.box([0, 0, 0, 1, 0, 0, 0], [1.0, 1.0, 0.01])
    turn = (1, 0, 0, 0) if kind == "capsule" else (np.sqrt(0.5), 0, np.sqrt(0.5), 0)
    depth = 0.005 + (R if kind == "capsule" else 0.0)
    assert distance(kind, (0, 0, 0), board, turn) == pytest.approx(-depth, abs=EXACT)


def test_what_is_far_counts_as_far() -> None:
    assert distance("box", (0, 0, 1.0), BOX) == pytest.approx(FAR_M)


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_no_hand_is_nearer_to_a_solid_than_it_says_by_mujocos_distances(name: str) -> None:
    """Exact for links that are boxes or round (1e-5 m: MuJoCo's meshes are float32 and converge to 1e-6); for hulls a
    lower bound."""
    hand, rng = hand_from_path(name), np.random.default_rng(2)
    corners = rng.normal(size=(40, 3)) * [0.03, 0.05, 0.04]
    solid, _ = outer_solid(corners)
    q = hand.lower + rng.random((60, hand.dofs)) * (hand.upper - hand.lower)
    quaternion = rng.normal(size=(60, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    postures = Posture(np.concatenate([rng.normal(size=(60, 3)) * 0.12, quaternion], axis=1), hand.expand(q))
    found = obstacle_distances(hand, postures, Environment((solid,), UP))
    true = geom_distances(hand, postures, solid)
    apart = true > 0
    assert (found[apart] <= true[apart] + 1e-5).all()
    assert (found[~apart] < 1e-5).all()
    assert 10 < apart.sum() < 55
    if not any(one.kind == "hull" for one in hand.pieces):
        np.testing.assert_allclose(found[apart], np.minimum(true[apart], FAR_M), atol=1e-5)


def geom_distances(hand: HandModel, postures: Posture, solid: Obstacle) -> np.ndarray:
    """(P,) least distance of a hand from a convex solid, by MuJoCo; at most 1 m."""
    from graspd.worker.scenes.neighbours import _add_piece

    spec = mujoco.MjSpec()
    mesh = spec.add_mesh(name="solid", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
    mesh.uservert = np.asarray(solid.corners, np.float32).ravel()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="solid")
    for k, one in enumerate(hand.pieces):
        _add_piece(spec, spec.worldbody.add_body(mocap=True), f"p{k}", one)
    model = spec.compile()
    data = mujoco.MjData(model)
    least = []
    for row in body_poses(hand, postures.hand_pose, postures.joint_positions):
        placed = row[[one.body for one in hand.pieces]]
        data.mocap_pos[:], data.mocap_quat[:] = placed[:, :3], placed[:, 3:]
        mujoco.mj_kinematics(model, data)
        least.append(min(mujoco.mj_geomDistance(model, data, 0, k + 1, 1.0, None) for k in range(len(hand.pieces))))
    return np.array(least)


def test_an_outer_solid_holds_its_points_and_stands_out_as_little_as_it_says() -> None:
    points = np.random.default_rng(0).normal(size=(400, 3))
    points *= 0.03 / np.linalg.norm(points, axis=1, keepdims=True)
    solid, error = outer_solid(points)
    assert len(solid.planes) <= MOST_PLANES
    assert solid.distance(points).max() <= 1e-9
    radius = np.linalg.norm(solid.corners, axis=1).max()
    assert radius - 0.03 <= error < radius - 0.03 + 5e-4, "the ball's points are up to half a millimetre apart from it"
    # Euler: every edge of the solid is there.
    faces = sum((np.abs(solid.corners @ p[:3] - p[3]) < 1e-6).sum() >= 3 for p in solid.planes)
    assert len(solid.corners) - len(solid.edges) + faces == 2


def test_an_outer_solid_of_a_box_is_the_box() -> None:
    solid, error = outer_solid(np.asarray(trimesh.creation.box((0.1, 0.2, 0.3)).vertices))
    assert (len(solid.planes), len(solid.corners), len(solid.edges)) == (6, 8, 12)
    assert error == pytest.approx(0, abs=1e-9)
