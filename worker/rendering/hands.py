"""The hand before the cameras: its bodies as solids with the looks that people know them by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worker.hands.kinematics import body_poses
from worker.hands.model import Floats, HandModel
from worker.objects.normals import corner_normals
from worker.rendering.palette import hexadecimal
from worker.rendering.scenery import Look, Solid

_HAND: Final = Look(hexadecimal("#59636e"), roughness=0.42, metalness=0.35)
_PALM: Final = Look(hexadecimal("#434b54"), roughness=0.48, metalness=0.35)
_TIP: Final = Look(hexadecimal("#2fa7a0"), roughness=0.38)
#: Where a hand waits that a scene does not show: under the floor, out of every picture [m].
_AWAY_M: Final = -50.0


@dataclass(frozen=True)
class DrawnHand:
    """The hand in its grasp pose, one grasp per scene, for pictures that people look at."""

    hand: HandModel
    grasp: NDArray[np.int32]
    """(S,) row of the grasp in the scene shard (in the base shard, where it was planned in its scene); -1: no hand."""
    hand_pose: Floats
    """(S, 7) root link in the table frame; ignored where there is no grasp."""
    joint_positions: Floats
    """(S, J)"""

    def body_poses(self) -> Floats:
        """(S, B, 7) poses of the drawn bodies in the table frame."""
        bodies = np.array(body_poses(self.hand, self.hand_pose, self.joint_positions))
        bodies[self.grasp < 0] = [0, 0, _AWAY_M, 1, 0, 0, 0]
        return bodies[:, drawn_bodies(self.hand)]


def drawn_bodies(hand: HandModel) -> list[int]:
    """Bodies that have a shape."""
    return sorted({piece.body for piece in hand.pieces})


def hand_solids(hand: HandModel) -> list[Solid]:
    """One mesh per body that has pieces, in the body frame."""
    return [_merge(hand, body) for body in drawn_bodies(hand)]


def look_of(hand: HandModel, body: int) -> Look:
    """Material of a body: palm, finger or fingertip."""
    if body in hand.fingertips:
        return _TIP
    return _PALM if body == 0 else _HAND


def _merge(hand: HandModel, body: int) -> Solid:
    vertices, faces, normals, count = [], [], [], 0
    for piece in hand.pieces:
        if piece.body == body:
            vertices.append(piece.vertices)
            faces.append(piece.faces + count)
            normals.append(corner_normals(piece.vertices, piece.faces))
            count += len(piece.vertices)
    return Solid(np.concatenate(vertices), np.concatenate(faces), np.concatenate(normals))
