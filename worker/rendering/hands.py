"""The hand in pictures: its bodies as solids with their visual appearance."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from cachetools import LRUCache, cached
from numpy.typing import NDArray

from graspd.service.model.colours import Colour, linear_rgb, linear_rgb_from_hex
from graspd.service.model.transforms import Floats
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.robot import Ints
from graspd.worker.hands.visuals import NO_VISUALS
from graspd.worker.objects.mesh_geometry import corner_normals
from graspd.worker.objects.topology import join_meshes
from graspd.worker.rendering.scenery import Appearance, Solid

_HAND: Final = Appearance(linear_rgb_from_hex("#59636e"), roughness=0.42, metalness=0.35)
_PALM: Final = Appearance(linear_rgb_from_hex("#434b54"), roughness=0.48, metalness=0.35)
_TIP: Final = Appearance(linear_rgb_from_hex("#2fa7a0"), roughness=0.38)
_AWAY_M: Final = -50.0  # z of a hidden hand [m]: under the floor, out of every picture


@dataclass(frozen=True)
class DrawnHand:
    """Hands in their grasp poses, one grasp per scene, for pictures."""

    hand: HandModel
    grasp: NDArray[np.int32]
    """(S,) row of the grasp in the scene shard (in the base shard if planned in its scene); -1 for no hand."""
    hand_pose: Floats  # (S, 7) root link in the table frame; ignored where there is no grasp
    joint_positions: Floats  # (S, J)
    wrist: Floats | None = None  # (S, U) wrist angles for drawing the links above the hand's root; None hides them

    def body_poses(self) -> Floats:
        """Return poses (S, B, 7) of the drawn bodies in the table frame."""
        bodies = drawn_poses(self.hand, self.hand_pose, self.joint_positions, self.wrist)
        bodies[self.grasp < 0] = [0, 0, _AWAY_M, 1, 0, 0, 0]
        return bodies

    @property
    def parts(self) -> tuple[MovingSolid, ...]:
        return drawn_parts(self.hand, mounted=self.wrist is not None)


@dataclass(frozen=True)
class MovingSolid:
    """A solid of one appearance that moves with a body."""

    body: int
    solid: Solid
    look: Appearance


@cached(LRUCache(16), key=lambda hand: hand.content, lock=threading.Lock())
def hand_parts(hand: HandModel) -> tuple[MovingSolid, ...]:
    """Return the visual meshes of a hand in their colours; for bodies without any, collision pieces.
    Without a stated colour, palm, fingers and fingertips have default appearances."""
    return tuple(_hand_solids(hand))


def drawn_parts(hand: HandModel, *, mounted: bool) -> tuple[MovingSolid, ...]:
    """Return the drawn solids of a hand; if `mounted`, also those of `hand.mounting` (own body numbers)."""
    return hand_parts(hand) + (hand_parts(hand.mounting) if mounted and hand.mounting is not None else ())


def drawn_poses(hand: HandModel, hand_pose: Floats, joint_positions: Floats, wrist: Floats | None) -> Floats:
    """Return poses (N, P, 7) of `drawn_parts` of N hands, mounted at wrist angles (N, U) if given."""
    poses = [body_poses(hand, hand_pose, joint_positions)[:, drawn_bodies(hand)]]
    if wrist is not None and (above := hand.mounting) is not None:
        poses.append(body_poses(above, hand_pose, above.expand(wrist))[:, drawn_bodies(above)])
    return np.concatenate(poses, axis=1)


def without_visuals(hand: HandModel) -> HandModel:
    """Return the hand with its mounting, drawn by its collision shapes."""
    above = None if hand.mounting is None else without_visuals(hand.mounting)
    return replace(hand, visuals=NO_VISUALS, mounting=above)


def drawn_bodies(hand: HandModel) -> list[int]:
    """Return the body of each drawn solid; a body of several colours is repeated."""
    return [part.body for part in hand_parts(hand)]


def _hand_solids(hand: HandModel) -> Iterator[MovingSolid]:
    seen = {mesh.body for mesh in hand.visuals.meshes}
    for body in range(hand.bodies):
        of_colour = defaultdict[Colour | None, list[tuple[Floats, Ints]]](list)
        for mesh in hand.visuals.meshes:
            if mesh.body == body:
                of_colour[mesh.colour].append((mesh.vertices, mesh.faces))
        for piece in hand.pieces:
            if piece.body == body and body not in seen:
                of_colour[None].append((piece.vertices, piece.faces))
        for colour, meshes in of_colour.items():
            look = (
                _default_appearance(hand, body) if colour is None else Appearance(linear_rgb(*colour), roughness=0.45)
            )
            yield MovingSolid(body, _merge(meshes), look)


def _default_appearance(hand: HandModel, body: int) -> Appearance:
    if body in hand.fingertips:
        return _TIP
    return _PALM if body == 0 else _HAND


def _merge(meshes: list[tuple[Floats, Ints]]) -> Solid:
    points, triangles = join_meshes(meshes)
    return Solid(points, triangles.astype(np.int32), np.concatenate([corner_normals(*mesh) for mesh in meshes]))
