"""Overlap of hand and object: pieces that share volume, and the depth of penetration."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, apply
from graspd.worker.hands.model import ConvexPiece, HandModel
from graspd.worker.quality.probe import Distances, Probe
from graspd.worker.simulation.device import to_xyzw
from graspd.worker.simulation.kernels import crossing as kernels
from graspd.worker.simulation.launches import launch

#: Planes are told apart by so many digits [m, and of unit normals].
_DIGITS: Final = 7


class Overlap:
    """The pieces of a hand against a closed object, by a feasible test: a piece that is left out shares nothing with
    it.

    No face of the object reaches into such a piece, no corner of it is in the object, and nothing of the object in it.
    Faces that only a plane through two edges would part from a piece count as reaching into it.
    """

    def __init__(self, hand: HandModel, probe: Probe) -> None:
        self._probe = probe
        self._body = np.array([p.body for p in hand.pieces], np.intp)
        self._corner = np.array([p.vertices[0] for p in hand.pieces])
        with wp.ScopedDevice("cpu"):
            wp.load_module(module=kernels, device="cpu")
        self._solids = _solids(hand.pieces)

    def of(self, found: Distances, near: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(B, P) pieces that may share volume with the object, among those that are `near` (B, P)."""
        row, piece = np.nonzero(near)
        if not len(row):
            return near
        poses = found.bodies[row, self._body[piece]]
        meets = self._crossed(piece, poses) | (found.piece_distance[row, piece] < 0)
        rest = np.flatnonzero(~meets)
        meets[rest] = self._probe.signed_distance(apply(poses[rest], self._corner[piece[rest]]))[0] < 0
        out = np.zeros_like(near)
        out[row, piece] = meets
        return out

    def _crossed(self, piece: NDArray[np.intp], poses: Floats) -> NDArray[np.bool_]:
        """(K,) pieces that a face of the object may reach into, their bodies at poses (K, 7)."""
        centre = self._probe.obj.centre_of_mass
        given = np.concatenate([poses[:, :3] - centre, to_xyzw(poses[:, 3:])], axis=1)
        with wp.ScopedDevice("cpu"):
            crossed = wp.zeros(len(piece), dtype=wp.int32)
            inputs = [
                self._probe.mesh.id,
                self._solids,
                wp.array(piece, dtype=wp.int32),
                wp.array(given, dtype=wp.transform),
            ]
            launch(kernels.faces_in_solids, len(piece), inputs=inputs, outputs=[crossed], device="cpu")
            found: NDArray[np.bool_] = crossed.numpy() != 0
        return found


def _solids(pieces: tuple[ConvexPiece, ...]) -> Any:
    planes, corners = [_planes(p) for p in pieces], [p.vertices for p in pieces]
    low, high = (np.array([f(c, axis=0) for c in corners]) for f in (np.min, np.max))
    solids = kernels.Solids()
    with wp.ScopedDevice("cpu"):
        solids.plane = wp.array(np.concatenate(planes), dtype=wp.vec4)
        solids.first_plane = wp.array(np.cumsum([0, *map(len, planes)]), dtype=wp.int32)
        solids.corner = wp.array(np.concatenate(corners), dtype=wp.vec3)
        solids.first_corner = wp.array(np.cumsum([0, *map(len, corners)]), dtype=wp.int32)
        solids.middle = wp.array((low + high) / 2, dtype=wp.vec3)
        solids.half = wp.array((high - low) / 2, dtype=wp.vec3)
    return solids


def _planes(piece: ConvexPiece) -> Floats:
    """(F, 4) planes n x <= d of a piece's faces, each once; every corner is below all of them."""
    a, b, c = (piece.vertices[piece.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    normal = normal[length > 0] / length[length > 0, None]
    offset = (normal @ piece.vertices.T).max(axis=1)
    # One of planes that are the same but for rounding, itself unrounded.
    _, first = np.unique(np.round(np.column_stack([normal, offset]), _DIGITS), axis=0, return_index=True)
    return np.column_stack([normal, offset])[first]


def penetration_depth(found: Distances) -> Floats:
    """(B,) deepest penetration, asked from both sides: hand points in the object, object points in the hand [m].

    One side alone is blind: a thin wall passes between hand points, a small fingertip between object points.
    """
    hand_in_object = np.maximum(0.0, -found.distance).max(axis=1)
    object_in_hand = np.maximum(0.0, -found.piece_distance).max(axis=1)
    deepest: Floats = np.maximum(hand_in_object, object_in_hand)
    return deepest
