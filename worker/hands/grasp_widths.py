"""Postures in which two parts of a hand face each other: for objects too narrow or wide for its pads.

An object of 10 mm is held between the sides of two fingers, or between a finger and the palm. An object as wide as the
hand's span is held between the sides of fingertips. In both cases two surface points have normals along the line
between them, and a cube fits between them. Sampling and random steps find such pairs."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, quat_rotate
from graspd.worker.hands import digits
from graspd.worker.hands.kinematics import body_poses, generalized_forces
from graspd.worker.hands.model import HandModel, SurfacePoints
from graspd.worker.hands.pinch_postures import PinchPostures, pinch_postures_of
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.memory_cache import cached_by_content

Ints = NDArray[np.intp]
Parts = tuple[NDArray[np.int32], NDArray[np.int32]]
Size = Literal["small", "wide"]

#: Least and largest gap for small objects [m]. Largest ratio of a gap for wide objects to the widest gap of pads.
SMALL_M: Final = (0.006, 0.042)
WIDER: Final = 1.06
#: Number of surface points.
POINTS: Final = {"small": 256, "wide": 640}
#: Numbers of postures, of candidates per posture, and of random steps that improve the postures.
POSTURES: Final = 120
CROWD: Final = 8
CLIMBS: Final = 80
#: Least cosine of both normals with the line between the points; costs of a lower cosine [m], and of a metre of
#: penetration of the hand into the cube between the points.
FACING: Final = {"small": 0.9, "wide": 0.8}
TURNED_M: Final = 0.2
DEEP: Final = 2.0
#: Motion of the two points towards each other below which a pair costs more, and least lever of a joint [m].
CLOSES_M: Final = 0.04
LEVER_M: Final = 0.02
#: Radius of the disc that a flat part covers on its tangent plane [m], and cost of a part that covers none of it [m].
FLAT_M: Final = 0.006
ROUND_M: Final = 0.003
_DENSE: Final = 4000
#: Largest cost of a usable posture [m].
GOOD_M: Final = 0.006
#: Largest distance by which the cube extends beyond its contacts towards the palm [m].
BEYOND_M: Final = 0.012
#: Number of surface points in the search for two given parts, and range of their gaps [m].
PART_POINTS: Final = 2000
THINNEST_M: Final = 0.003
PART_WIDTH_M: Final = 0.07
#: Number of pairs per posture that are evaluated in detail, and number of postures evaluated at once.
CLOSELY: Final = 8
AT_ONCE: Final = 16
#: Points nearer than this coincide [m].
_NEXT_TO: Final = 1e-9


@cached_by_content(32)
def postures_for_size(hand: HandModel, size: Size) -> PinchPostures:
    """Return postures for small or wide objects, cached in memory and on disk."""
    key = (hand.content, size)
    return PinchPostures.load_or_search("spans", key, lambda: _search_postures(hand, size), sys.modules[__name__])


@cached_by_content(16)
def postures_between(hand: HandModel, first: NDArray[np.int32], second: NDArray[np.int32]) -> PinchPostures:
    """Return postures in which two parts of a hand face each other, cached in memory and on disk.
    Each part is given by the `digits.Part` (L,) of each body."""
    return PinchPostures.load_or_search(
        "parts",
        (hand.content, str(first.tolist()), str(second.tolist())),
        lambda: _search_postures(hand, "small", (first, second)),
        sys.modules[__name__],
        digits,
    )


def largest_width(hand: HandModel) -> float:
    """Return an upper bound of the widths in `postures_for_size` [m], from `pinch_postures_of` alone."""
    return WIDER * pinch_postures_of(hand).widest + GOOD_M


def _search_postures(hand: HandModel, size: Size, parts: Parts | None = None) -> PinchPostures:
    widest = pinch_postures_of(hand).widest
    least, most = SMALL_M if size == "small" else (widest, WIDER * widest)
    if parts is not None:
        least, most = THINNEST_M, PART_WIDTH_M
    rng, look = np.random.default_rng(0), _PairSearch(hand, size, parts)
    wanted = np.linspace(least, most, POSTURES)
    q = rng.uniform(hand.lower, hand.upper, (CROWD * POSTURES, hand.dofs))
    found = look.at(q, np.repeat(wanted, CROWD))
    best = found.cost.reshape(POSTURES, CROWD).argmin(axis=1) + CROWD * np.arange(POSTURES)
    q, found = q[best], look.at(q[best], wanted)
    for step in np.geomspace(0.3, 0.03, CLIMBS):
        noise = rng.standard_normal(q.shape) * (rng.random(q.shape) < 0.5)
        tried = np.clip(q + step * hand.span * noise, hand.lower, hand.upper)
        new = look.at(tried, wanted)
        better = new.cost < found.cost
        q[better] = tried[better]
        found.take(better, new)
    return PinchPostures.select(q, found, np.flatnonzero(found.cost < GOOD_M))


@dataclass
class _BestPairs:
    """Best pair of points in each of N postures: fields as in `PinchPostures`, and costs (N,) [m]."""

    axis: Floats
    middle: Floats
    width: Floats
    cost: Floats

    def take(self, rows: NDArray[np.bool_], other: _BestPairs) -> None:
        """Replace the rows of a mask (N,) by those of `other`."""
        for mine, its in zip(vars(self).values(), vars(other).values(), strict=True):
            mine[rows] = its[rows]


class _PairSearch:
    """Evaluates pairs of surface points as grips, in given postures."""

    def __init__(self, hand: HandModel, size: Size, parts: Parts | None = None) -> None:
        self.hand, self.facing = hand, FACING[size]
        self.points = sample_surface(hand, POINTS[size] if parts is None else PART_POINTS)
        body = self.points.body
        holds = np.ones(len(body), bool) if size == "small" else np.isin(body, hand.fingertips)
        chosen = [digits.points_of_parts(hand, part, self.points) for part in parts or ()]
        if parts is not None:
            holds = chosen[0] | chosen[1]
        # Sorted by body, so that one matrix product compares a body's points with those of all later bodies.
        self.holding = np.flatnonzero(holds)[np.argsort(body[holds], kind="stable")]
        flat = _flatness(hand, self.points)[self.holding] if size == "small" else np.ones(len(self.holding))
        self.round = ROUND_M * (1 - np.minimum(flat[:, None], flat))
        count = len(self.holding)
        ends = np.flatnonzero(np.diff(body[self.holding])) + 1
        self.blocks = [(slice(a, b), slice(b, count)) for a, b in zip([0, *ends[:-1]], ends, strict=True)]
        pairs = [np.mgrid[mine, later].reshape(2, -1) for mine, later in self.blocks]
        self.one, self.other = np.concatenate(pairs, axis=1)
        self.excluded = np.zeros(len(self.one), bool)
        if parts is not None:
            first, second = (part[self.holding] for part in chosen)
            between = (first[self.one] & second[self.other]) | (second[self.one] & first[self.other])
            self.excluded = ~between

    def at(self, q: Floats, wanted: Floats) -> _BestPairs:
        """Return the best pair of each posture (n, D) for the widths `wanted` (n,)."""
        rows = np.array_split(np.arange(len(q)), 1 + len(q) // AT_ONCE)
        parts = [self._at(q[some], wanted[some]) for some in rows]
        return _BestPairs(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def _at(self, q: Floats, wanted: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        hand, points = self.hand, self.points
        bodies = body_poses(hand, np.tile(IDENTITY_POSE, (len(q), 1)), hand.expand(q))
        pose = bodies[:, points.body]
        place, normal = apply(pose, points.position), quat_rotate(pose[..., 3:], points.normal)[:, self.holding]
        held = place[:, self.holding]
        costs = self._costs(held, normal, wanted)
        close = np.argpartition(costs, CLOSELY, axis=1)[:, :CLOSELY]
        row = np.arange(len(q))[:, None]
        one, other, cost = self.one[close], self.other[close], costs[row, close]
        ends = held[row, one], held[row, other]
        way = ends[1] - ends[0]
        width = np.sqrt(np.einsum("npi,npi->np", way, way))
        axis = way / width[..., None]
        cost += DEEP * self._penetration(place, axis, *ends, width)
        parts = self.holding[one], self.holding[other]
        cost += np.maximum(0.0, CLOSES_M - self._closing_distance(q, bodies, axis, parts, ends))
        best = np.arange(len(q)), cost.argmin(axis=1)
        return axis[best], 0.5 * (ends[0] + ends[1])[best], width[best], cost[best]

    def _costs(self, held: Floats, normal: Floats, wanted: Floats) -> Floats:
        """Compute the cost (n, pairs) of each pair by matrix products, without penetration and closing motion.
        The square of a width has a rounding error of 1e-17 m²."""
        square = np.einsum("npi,npi->np", held, held)
        own = np.einsum("npi,npi->np", held, normal)
        parts = []
        for one, other in self.blocks:
            mine, its = held[:, one], held[:, other].swapaxes(1, 2)
            width = square[:, one, None] + square[:, None, other] - 2 * (mine @ its)
            np.sqrt(np.maximum(width, _NEXT_TO**2, out=width), out=width)
            cost = normal[:, one] @ its - own[:, one, None]
            np.minimum(cost, mine @ normal[:, other].swapaxes(1, 2) - own[:, None, other], out=cost)
            cost /= width
            np.subtract(self.facing, cost, out=cost)
            cost = TURNED_M * np.maximum(0.0, cost, out=cost)
            width -= wanted[:, None, None]
            cost += np.abs(width, out=width)
            cost += self.round[one, other]
            parts.append(cost.reshape(len(held), -1))
        found = np.concatenate(parts, axis=1)
        found[:, self.excluded] = np.inf
        return found

    def _closing_distance(
        self, q: Floats, bodies: Floats, axis: Floats, parts: tuple[Ints, Ints], ends: tuple[Floats, Floats]
    ) -> Floats:
        """Return the distance (n, K) by which two points can approach each other, to first order [m]."""
        hand, rate = self.hand, np.zeros((*axis.shape[:2], self.hand.dofs))
        for part, end, sign in zip(parts, ends, (-1.0, 1.0), strict=True):
            rate += sign * generalized_forces(hand, bodies, self.points.body[part], end, axis[:, :, None])[:, :, 0]
        room = np.where(rate < 0, (hand.upper - q)[:, None], (q - hand.lower)[:, None])
        return np.asarray(np.where(np.abs(rate) > LEVER_M, np.abs(rate) * room, 0.0).sum(axis=2))

    def _penetration(self, place: Floats, axis: Floats, one: Floats, other: Floats, width: Floats) -> Floats:
        """Return the penetration (n, K) of the hand into cubes between two of its points [m]."""
        ahead = self.hand.palm.approach
        up = ahead - np.einsum("nki,i->nk", axis, ahead)[..., None] * axis
        length = np.linalg.norm(up, axis=2, keepdims=True)
        up = np.where(length > 0.1, up / np.maximum(length, 0.1), _perpendicular(axis))
        half = 0.5 * width
        start = np.minimum(np.einsum("nki,nki->nk", one, up), np.einsum("nki,nki->nk", other, up))
        start = start - np.minimum(half, BEYOND_M)
        # Coordinates (n, K, points): along the line between both ends, perpendicular to it, and upwards.
        middle, points, across = 0.5 * (one + other), place.swapaxes(1, 2), np.cross(axis, up)
        along, aside, above = axis @ points, across @ points, up @ points
        along -= np.einsum("nki,nki->nk", axis, middle)[..., None]
        aside -= np.einsum("nki,nki->nk", across, middle)[..., None]
        above -= (start + half)[..., None]
        beside = np.maximum(np.maximum(np.abs(along), np.abs(aside)), np.abs(above))
        return np.asarray(np.maximum(half[..., None] - beside, 0.0).max(axis=2))


def _flatness(hand: HandModel, points: SurfacePoints) -> Floats:
    """Return the share (N,) of a disc on each point's tangent plane that the point's body covers."""
    dense = sample_surface(hand, _DENSE)
    flat = np.zeros(len(points))
    for body in np.unique(points.body):
        mine, its = points.body == body, dense.body == body
        off = dense.position[its][None] - points.position[mine][:, None]
        height = np.einsum("npi,ni->np", off, points.normal[mine])
        near = (np.linalg.norm(off, axis=2) < FLAT_M) & (np.abs(height) < 0.1 * FLAT_M)
        flat[mine] = near @ dense.area[its]
    return np.minimum(1.0, flat / (np.pi * FLAT_M**2))


def _perpendicular(axis: Floats) -> Floats:
    helper = np.eye(3)[np.argmin(np.abs(axis), axis=-1)]
    across = np.cross(axis, helper)
    return np.asarray(across / np.linalg.norm(across, axis=-1, keepdims=True))
