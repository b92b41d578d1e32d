"""What of a hand can touch a plane first: points with a radius (balls) and circles about an axis (rims)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import quat_rotate

if TYPE_CHECKING:
    from worker.hands.model import ConvexPiece

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class HandFeatures:
    """F balls and rims, fixed to the bodies of a hand."""

    body: NDArray[np.int32]
    """(F,)"""
    centre: Floats
    """(F, 3) body frame."""
    axis: Floats
    """(F, 3) body frame; zero: a ball."""
    radius: Floats
    """(F,)"""

    def __len__(self) -> int:
        return len(self.body)

    @classmethod
    def of(cls, pieces: tuple[ConvexPiece, ...]) -> HandFeatures:
        """Corners of boxes and hulls, spheres, ends of capsules, rims of cylinders."""
        rows: list[tuple[int, Floats, Floats, float]] = []
        ball = np.zeros(3)
        for piece in pieces:
            middle, axis = piece.pose[:3], quat_rotate(piece.pose[3:], np.array([0.0, 0.0, 1.0]))
            if piece.kind == "sphere":
                rows.append((piece.body, middle, ball, piece.size[0]))
            elif piece.kind in ("capsule", "cylinder"):
                radius, length = piece.size
                about = axis if piece.kind == "cylinder" else ball
                rows += [(piece.body, middle + 0.5 * end * length * axis, about, radius) for end in (-1, 1)]
            else:
                rows += [(piece.body, corner, ball, 0.0) for corner in piece.vertices]
        return cls(
            np.array([r[0] for r in rows], np.int32),
            np.array([r[1] for r in rows]).reshape(-1, 3),
            np.array([r[2] for r in rows]).reshape(-1, 3),
            np.array([r[3] for r in rows]),
        )
