"""Pinch postures for flat objects on a support: ends of opposed fingertips on a plane, face to face.

The pads of `worker.hands.pinch_postures` are farther from the fingertips' ends than a flat object is high. The search
is the same, but over the surface within the object's height above the plane."""

import sys
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, quat_rotate
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel, SurfacePoints
from graspd.worker.hands.pinch_postures import PinchPostures, improve_postures, opposing_finger, random_postures
from graspd.worker.hands.surface import farthest_points, sample_surface
from graspd.worker.objects.memory_cache import cached_by_content

#: Object heights, each with its own postures [m]; higher objects reach the pads.
HEIGHTS_M: Final = (0.005, 0.008, 0.012, 0.018)
#: Number of postures, and number of candidates per posture.
POSTURES: Final = 120
CROWD: Final = 20
#: Least number of valid postures of a height; fewer are discarded.
FEW: Final = 8
#: Range of widths [m].
WIDTHS_M: Final = (0.004, 0.12)
#: Numbers of points on each fingertip and on each other body, drawn from `_DENSE` points on the whole hand.
_TIP_POINTS: Final = 120
_OTHER_POINTS: Final = 20
_DENSE: Final = 8000
#: A fingertip that ends above the plane by more than this share of the height misses the object.
REACHES: Final = 0.4
#: Difference of width that costs 1 [m].
WIDTH_M: Final = 0.02
#: Least height of the rest of the hand above the plane [m].
OVER_M: Final = 0.008
#: Limits on the line between the ends: least cosine with their normals, largest cosine with the palm's approach.
FACING: Final = 0.8
SQUARE: Final = 0.7


def flat_pinches(hand: HandModel, height: float) -> PinchPostures:
    """Return postures for objects of a height [m]; none for one finger or objects as high as the pads.
    The component of the palm's approach perpendicular to `axis` points at the plane, half the height below `middle`."""
    known = [h for h in HEIGHTS_M if h >= height]
    return _cached_pinches(hand, known[0]) if known and len(hand.fingertips) > 1 else PinchPostures.empty(hand)


@cached_by_content(32)
def _cached_pinches(hand: HandModel, height: float) -> PinchPostures:
    key = (hand.content, str(height))
    return PinchPostures.load_or_search("pinches", key, lambda: _search_pinches(hand, height), sys.modules[__name__])


def _search_pinches(hand: HandModel, height: float) -> PinchPostures:
    one, look = opposing_finger(hand), _PinchSearch(hand, height)
    q = random_postures(hand, one, CROWD * POSTURES)
    wanted = np.linspace(*WIDTHS_M, POSTURES)
    cost = look.evaluate(q, one).cost(np.repeat(wanted, CROWD))
    q = q[np.arange(POSTURES) * CROWD + cost.reshape(POSTURES, CROWD).argmin(axis=1)]
    q = improve_postures(hand, one, q, lambda tried: look.evaluate(tried, one).cost(wanted))
    seen = look.evaluate(q, one)
    faces = (seen.facing > FACING) & (seen.square < SQUARE)
    good = np.flatnonzero(faces & (seen.short < 1.0) & (seen.over > OVER_M) & (seen.width > WIDTHS_M[0]))
    return PinchPostures.select(q, seen, good if len(good) >= FEW else good[:0])


@dataclass(frozen=True)
class _PinchQuality:
    """Pinches between the fingertips' ends in N postures, and their quality; root frame."""

    axis: Floats
    middle: Floats
    width: Floats
    short: Floats
    """(N,) height of the ends above the plane, relative to the largest height that reaches the object.
    The larger value counts, that of the opposing end or the mean of the other ends."""
    facing: Floats
    """(N,) cosine between the line of the ends and the normals within the height; the lower value of both sides."""
    square: Floats
    over: Floats  # (N,) height of the rest of the hand above the plane [m]

    def cost(self, wanted: Floats) -> Floats:
        """Return the cost (N,) of postures as pinches of the widths `wanted` (N,)."""
        short = np.maximum(0.0, self.short - 0.5)
        low = np.maximum(0.0, OVER_M + 0.005 - self.over) / WIDTH_M
        aside = 2 * np.maximum(0.0, self.square - 0.9 * SQUARE)
        facing = 2 * short - 2 * np.minimum(self.facing, 0.95)
        return np.asarray(facing + np.abs(self.width - wanted) / WIDTH_M + low + aside)


class _PinchSearch:
    """Evaluates pinches of a hand by points on its fingertips and on its other bodies."""

    def __init__(self, hand: HandModel, height: float) -> None:
        self.hand, self.height = hand, height
        points = sample_surface(hand, _DENSE)
        tips = [_spread_points(points, tip, _TIP_POINTS) for tip in hand.fingertips]
        mine = np.stack([np.resize(some, _TIP_POINTS) for some in tips])
        others = np.setdiff1d(points.body, hand.fingertips).tolist()
        rest = np.concatenate([_spread_points(points, body, _OTHER_POINTS) for body in others])
        self.tips, self.normals = points.position[mine], points.normal[mine]  # (F, V, 3) body frames [m]
        self.others, self.body = points.position[rest], points.body[rest].astype(np.intp)  # (W, 3), (W,)

    def evaluate(self, q: Floats, one: int) -> _PinchQuality:
        """Evaluate the pinch between the finger `one` and the others in postures (N, D)."""
        hand, others = self.hand, [f for f in range(len(self.tips)) if f != one]
        bodies = body_poses(hand, np.tile(IDENTITY_POSE, (len(q), 1)), hand.expand(q))
        tips = bodies[:, list(hand.fingertips), None]
        place, normal = apply(tips, self.tips), quat_rotate(tips[..., 3:], self.normals)
        down = np.tile(hand.palm.approach, (len(q), 1))
        # The plane and the points that touch it depend on each other.
        for _ in range(3):
            low = np.einsum("nfvi,ni->nfv", place, down).argmax(axis=2)
            end = np.take_along_axis(place, low[..., None, None], axis=2)[:, :, 0]
            axis = _unit(end[:, others].mean(axis=1) - end[:, one])
            down = _unit(hand.palm.approach - (axis @ hand.palm.approach)[:, None] * axis)
        depth = np.einsum("nfvi,ni->nfv", place, down)
        ends = depth.max(axis=2)
        plane = ends.max(axis=1)
        above = (plane[:, None] - ends) / (REACHES * self.height)
        short = np.maximum(above[:, one], np.minimum(above[:, others], 2.0).mean(axis=1))
        sign = np.where(np.arange(len(self.tips)) == one, 1.0, -1.0)[None, :, None]
        along = sign * np.einsum("nfvi,ni->nfv", place, axis)
        looks = sign * np.einsum("nfvi,ni->nfv", normal, axis)
        within = plane[:, None, None] - depth <= self.height
        inner = np.where(within, along, -np.inf).max(axis=2)
        inner = np.where(np.isfinite(inner), inner, np.take_along_axis(along, low[..., None], axis=2)[..., 0])
        face = np.where(within, looks, -1.0).max(axis=2)
        counts = np.maximum(above[:, others] < 1.0, 1e-6)
        far = (inner[:, others] * counts).sum(axis=1) / counts.sum(axis=1)
        facing = np.minimum(face[:, one], (face[:, others] * counts).sum(axis=1) / counts.sum(axis=1))
        width = -far - inner[:, one]
        across = np.cross(down, axis)
        middle = (
            0.5 * (inner[:, one] - far)[:, None] * axis
            + (plane - 0.5 * self.height)[:, None] * down
            + np.einsum("ni,ni->n", end[:, one] + end[:, others].mean(axis=1), across)[:, None] * 0.5 * across
        )
        lowest = np.einsum("nvi,ni->nv", apply(bodies[:, self.body], self.others), down).max(axis=1)
        return _PinchQuality(axis, middle, width, short, facing, np.abs(axis @ hand.palm.approach), plane - lowest)


def _spread_points(points: SurfacePoints, body: int, count: int) -> NDArray[np.intp]:
    mine = np.flatnonzero(points.body == body)
    return mine[farthest_points(points.position[mine], min(count, len(mine)))]


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9))
