"""Distances to convex pieces against closed forms; planes of hulls."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
import warp as wp

from graspd.service.model.transforms import apply, invert
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import piece_distance
from graspd.worker.simulation import kernels
from graspd.worker.simulation.device import DeviceHand, face_planes
from graspd.worker.simulation.kernels import pieces


@wp.kernel
def ask(pieces_in: pieces.Pieces, piece_in: int, point_in: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec4)):
    i = wp.tid()
    local = wp.quat_rotate_inv(pieces_in.pose_q[piece_in], point_in[i] - pieces_in.pose_p[piece_in])
    out[i] = pieces.piece_distance(pieces_in, piece_in, local)


def distances(hand: HandModel, index: int, points: np.ndarray) -> np.ndarray:
    device = DeviceHand.create(hand, "cpu")
    with wp.ScopedDevice("cpu"):
        out = wp.zeros(len(points), dtype=wp.vec4)
        wp.launch(ask, len(points), inputs=[device.pieces, index, wp.array(points, dtype=wp.vec3)], outputs=[out])
        return out.numpy().astype(float)


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_depths_inside_every_piece_agree_with_the_float64_distance(name: str) -> None:
    kernels.load("cpu")
    hand = hand_from_path(name)
    rng = np.random.default_rng(0)
    checked = 0
    for index, piece in enumerate(hand.pieces):
        low, high = piece.vertices.min(axis=0), piece.vertices.max(axis=0)
        points = rng.uniform(low, high, (200, 3))
        expected = piece_distance(piece, points)
        found = distances(hand, index, points)[:, 3]
        inside = expected < -1e-6
        np.testing.assert_allclose(found[inside], expected[inside], atol=5e-8)
        assert np.all(found[expected > 1e-6] > 0)
        checked += int(inside.sum())
    assert checked > 1000


def test_the_gradient_is_unit_and_climbs_out() -> None:
    hand = hand_from_path("allegro")
    rng = np.random.default_rng(1)
    for index, piece in enumerate(hand.pieces):
        points = rng.uniform(piece.vertices.min(axis=0), piece.vertices.max(axis=0), (50, 3))
        answer = distances(hand, index, points)
        np.testing.assert_allclose(np.linalg.norm(answer[:, :3], axis=1), 1, atol=1e-5)
        frame = np.concatenate([piece.pose[:3], piece.pose[3:]])
        local = apply(invert(frame), points) + 1e-5 * answer[:, :3]
        climbed = distances(hand, index, apply(frame, local))[:, 3]
        inside = answer[:, 3] < -2e-5
        np.testing.assert_allclose((climbed - answer[:, 3])[inside], 1e-5, atol=2e-7)


def test_a_box_has_six_planes_however_it_is_triangulated() -> None:
    box = trimesh.creation.box((0.02, 0.03, 0.05)).subdivide()
    planes = face_planes(np.asarray(box.vertices), np.asarray(box.faces))
    assert len(planes) == 6
    np.testing.assert_allclose(np.sort(planes[:, 3]), [0.01, 0.01, 0.015, 0.015, 0.025, 0.025], atol=1e-12)
