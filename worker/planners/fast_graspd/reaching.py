"""Starts around a free object between opposed fingers, where it fits.

A hand that faces a random place of a large box mostly finds it too wide. Here the hand is placed around a drawn pair of
points that face away from each other, no farther apart than the hand opens. In most draws a finger or the palm
penetrates the object: balls in the hand reject these before the simulation checks a draw.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.transforms import IDENTITY_POSE, Floats, quat_from_matrix, quat_rotate
from graspd.worker.hands.grasp_widths import Size, spans_of, widest_span
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import Oppositions, oppositions_of
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.antipodal_starts import ALIKE_M, BESIDE_M, NOISE, ROOM_M, crossings_of, frames
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.device import to_wxyz, to_xyzw
from graspd.worker.simulation.kernels import reaching as kernels
from graspd.worker.simulation.launches import launch
from graspd.worker.simulation.model import Model

#: Draws per start, and the number of draws clear by the ball test that the simulation checks.
DRAWS: Final = 512
LOOKS: Final = 8
#: Chance of a pair far from the centre of mass, relative to a pair through it.
FAR: Final = 0.05
#: Number of balls in the hand and their radius [m]: they touch its surface from within and protrude from thinner links.
BALLS: Final = 96
BALL_M: Final = 0.005
#: An object is small if all its pairs are narrower than this and than the smallest gap of the hand's pads [m].
SMALL_M: Final = 0.017
#: Error of the grid's distances [m].
SLACK_M: Final = 0.001


@dataclass(frozen=True)
class ReachSampling:
    model: Model
    grips: Any
    only: bool
    """Whether all starts reach across, because the object is too small or too wide for the pads.
    Starts that face a random point then rarely succeed."""

    @classmethod
    def of(cls, model: Model) -> ReachSampling | None:
        """Return None if the hand opposes no fingers, or the object is too wide everywhere."""
        known = _grips(model.hand.model, model.obj.model, model.device)
        return None if known is None else cls(model, *known)

    def starts(self, seeds: NDArray[np.int32], first: NDArray[np.int32], retreats: Floats) -> tuple[HandState, Any]:
        """Return hands (n,) of the first draws, from numbers `first` (n,) on, that pass the ball test.
        Also return the draws' numbers (n,), -1 if there is none. `retreats`: ascending steps from the object [m]."""
        m, count = self.model, len(seeds)
        with wp.ScopedDevice(m.device):
            number = wp.empty(count, dtype=wp.int32)
            pivot, rotation = wp.zeros(count, dtype=wp.vec3), wp.zeros(count, dtype=wp.quat)
            q = wp.zeros((count, m.dofs), dtype=wp.float32)
            launch(
                kernels.reach,
                count,
                inputs=[
                    m.obj.surface,
                    self.grips,
                    wp.array(seeds, dtype=wp.int32),
                    wp.array(first, dtype=wp.int32),
                    DRAWS,
                    wp.vec2(*ALIKE_M),
                    wp.vec2(*ROOM_M),
                    wp.array(retreats, dtype=wp.float32),
                ],
                outputs=[number, pivot, rotation, q],
            )
        found = HandState(pivot.numpy().astype(float), to_wxyz(rotation.numpy().astype(float)), q.numpy().astype(float))
        return found, number.numpy()


def size_to_pads(hand: HandModel, width: Floats) -> Size | None:
    """Classify an object with pair widths (P,) as too small or wide for the pads; None if a pair fits."""
    known = oppositions_of(hand)
    if not len(known) or not len(width):
        return None
    if width.max() < min(SMALL_M, known.width[0]):
        return "small"
    return "wide" if width.min() + 2 * ROOM_M[0] > known.widest else None


def _postures(hand: HandModel, width: Floats, size: Size | None) -> Oppositions:
    """Return the postures for pairs of the widths (P,), empty if none holds a pair."""
    if size == "wide" and width.min() + 2 * ROOM_M[0] > widest_span(hand):
        return Oppositions.of_none(hand)
    known = oppositions_of(hand) if size is None else spans_of(hand, size)
    return known if (width + 2 * ROOM_M[0] <= known.widest).any() else Oppositions.of_none(hand)


@cached_by_content(8)
def _grips(hand: HandModel, obj: ObjectModel, device: str) -> tuple[Any, bool] | None:
    """Return `ReachSampling.grips` and `.only`; None if no posture holds a pair."""
    pairs, out = crossings_of(obj), kernels.Grips()
    size = size_to_pads(hand, pairs.width)
    known = _postures(hand, pairs.width, size)
    if not len(known):
        return None
    kept = np.flatnonzero(pairs.width + 2 * ROOM_M[0] <= known.widest)
    middle = pairs.middle[kept] - obj.centre_of_mass
    chance = np.exp(-((np.linalg.norm(middle, axis=1) / BESIDE_M) ** 2)) + FAR
    points = sample_surface(hand, BALLS)
    pose = body_poses(hand, np.tile(IDENTITY_POSE, (len(known), 1)), hand.expand(known.q))[:, points.body]
    balls = quat_rotate(pose[..., 3:], points.position - BALL_M * points.normal) + pose[..., :3] - hand.palm.centre
    own = quat_from_matrix(frames(known.axis, np.tile(hand.palm.approach, (len(known), 1))))
    with wp.ScopedDevice(device):
        out.middle, out.axis = wp.array(middle, dtype=wp.vec3), wp.array(pairs.axis[kept], dtype=wp.vec3)
        out.width = wp.array(pairs.width[kept], dtype=wp.float32)
        out.sums = wp.array(np.cumsum(chance) / chance.sum(), dtype=wp.float32)
        out.posture = wp.array(known.q, dtype=wp.float32)
        out.between = wp.array(known.middle - hand.palm.centre, dtype=wp.vec3)
        out.frame = wp.array(to_xyzw(own), dtype=wp.quat)
        out.opened = wp.array(known.width, dtype=wp.float32)
        out.balls = wp.array(balls, dtype=wp.vec3)
        out.radius = BALL_M - SLACK_M
        # Objects that are too small or too wide are held where space was found, never nearer to the palm.
        out.deep = 0.0 if size else 1.0
        out.palm = wp.vec3(*hand.palm.approach)
        out.noise = wp.array(NOISE * hand.span, dtype=wp.float32)
        out.lower, out.upper = wp.array(hand.lower, dtype=wp.float32), wp.array(hand.upper, dtype=wp.float32)
    return out, size is not None
