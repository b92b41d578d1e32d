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

#: Planes are distinguished by so many digits [m, and of unit normals].
_DIGITS: Final = 7


class Overlap:
    """Conservative overlap test of a hand's pieces with a closed object.
    A piece is excluded only if it shares no volume: no face of the object reaches into it, none of its corners is in
    the object, and nothing of the object is in it. A face also counts if only a plane through
    two edges would separate it."""

    def __init__(self, hand: HandModel, probe: Probe) -> None:
        self._probe = probe
        self._body = np.array([p.body for p in hand.pieces], np.intp)
        self._corner = np.array([p.vertices[0] for p in hand.pieces])
        with wp.ScopedDevice("cpu"):
            wp.load_module(module=kernels, device="cpu")
        self._solids = _solids(hand.pieces)

    def of(self, found: Distances, near: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the pieces (B, P), among those that are `near` (B, P), that may share volume with the object."""
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
    """Return the distinct planes (F, 4) n x <= d of a piece's faces; every corner is below all of them."""
    a, b, c = (piece.vertices[piece.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    normal = normal[length > 0] / length[length > 0, None]
    offset = (normal @ piece.vertices.T).max(axis=1)
    # One of the planes that are equal except for rounding, itself unrounded.
    _, first = np.unique(np.round(np.column_stack([normal, offset]), _DIGITS), axis=0, return_index=True)
    return np.column_stack([normal, offset])[first]


def penetration_depth(found: Distances) -> Floats:
    """Return the deepest penetration (B,), of hand points in the object and object points in the hand [m].
    One direction alone is blind: a thin wall passes between hand points, a small fingertip between object points."""
    hand_in_object = np.maximum(0.0, -found.distance).max(axis=1)
    object_in_hand = np.maximum(0.0, -found.piece_distance).max(axis=1)
    deepest: Floats = np.maximum(hand_in_object, object_in_hand)
    return deepest
