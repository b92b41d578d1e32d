"""What of a hand can touch first: points with a radius (balls), circles about an axis (rims), edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import Floats, quat_rotate

if TYPE_CHECKING:
    from worker.hands.model import ConvexPiece


#: Two triangles whose normals have at least this cosine are one flat face: 0.1 degrees.
COPLANAR: Final = 1 - 1.5e-6


@dataclass(frozen=True)
class HandFeatures:
    """F balls and rims and E edges of P convex pieces, fixed to the bodies of a hand.

    A plane meets balls and rims first; a convex solid that a piece runs into meets one of them or an edge.
    """

    body: NDArray[np.int32]
    """(F,)"""
    centre: Floats
    """(F, 3) body frame."""
    axis: Floats
    """(F, 3) body frame; zero: a ball."""
    radius: Floats
    """(F,)"""
    first: NDArray[np.int32]
    """(P + 1,) the first feature of each piece."""
    edges: Floats
    """(E, 2, 3) ends, body frame."""
    thickness: Floats
    """(E,) radius about an edge: 0 but for capsules and spheres."""
    first_edge: NDArray[np.int32]
    """(P + 1,)"""

    def __len__(self) -> int:
        return len(self.body)

    @classmethod
    def of(cls, pieces: tuple[ConvexPiece, ...]) -> HandFeatures:
        """Corners and edges of boxes and hulls, spheres, ends and axes of capsules, rims and axes of cylinders."""
        rows: list[tuple[int, Floats, Floats, float]] = []
        edges: list[Floats] = [np.zeros((0, 2, 3))]
        thickness: list[float] = []
        first, first_edge = [0], [0]
        ball = np.zeros(3)
        for piece in pieces:
            found, thick = _edges(piece)
            edges.append(found)
            thickness += [thick] * len(found)
            middle, axis = piece.pose[:3], quat_rotate(piece.pose[3:], np.array([0.0, 0.0, 1.0]))
            if piece.kind == "sphere":
                rows.append((piece.body, middle, ball, piece.size[0]))
            elif piece.kind in ("capsule", "cylinder"):
                radius, length = piece.size
                about = axis if piece.kind == "cylinder" else ball
                rows += [(piece.body, middle + 0.5 * end * length * axis, about, radius) for end in (-1, 1)]
            else:
                rows += [(piece.body, corner, ball, 0.0) for corner in piece.vertices]
            first.append(len(rows))
            first_edge.append(len(thickness))
        return cls(
            np.array([r[0] for r in rows], np.int32),
            np.array([r[1] for r in rows]).reshape(-1, 3),
            np.array([r[2] for r in rows]).reshape(-1, 3),
            np.array([r[3] for r in rows]),
            np.array(first, np.int32),
            np.concatenate(edges),
            np.array(thickness),
            np.array(first_edge, np.int32),
        )


def _edges(piece: ConvexPiece) -> tuple[Floats, float]:
    """Ends (E, 2, 3) of a piece's edges, and their radius; round pieces have their axis."""
    middle, axis = piece.pose[:3], quat_rotate(piece.pose[3:], np.array([0.0, 0.0, 1.0]))
    if piece.kind == "sphere":
        return np.array([[middle, middle]]), piece.size[0]
    if piece.kind in ("capsule", "cylinder"):
        radius, length = piece.size
        ends = np.array([[middle - 0.5 * length * axis, middle + 0.5 * length * axis]])
        return ends, radius if piece.kind == "capsule" else 0.0
    return piece.vertices[convex_edges(piece.vertices, piece.faces)], 0.0


def convex_edges(vertices: Floats, faces: NDArray[np.integer[Any]]) -> NDArray[np.intp]:
    """(E, 2) edges of a convex solid of outward triangles where its surface bends; those within flat faces are none."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    order = np.lexsort(sides.T)
    one, other = order[0::2], order[1::2]
    if len(one) != len(other) or (sides[one] != sides[other]).any():
        return np.unique(sides, axis=0)  # not closed: rather an edge too many
    count = len(faces)
    bends = (normal[one % count] * normal[other % count]).sum(axis=1) < COPLANAR
    return np.asarray(sides[one[bends]], np.intp)
