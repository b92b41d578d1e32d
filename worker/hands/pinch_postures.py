"""Pinch postures of a hand, sorted by width, and a test whether its surfaces can oppose one another.

A hand holds an object between one finger, usually the thumb, and other fingers whose pads face it. Sampling and random
steps find such postures for all feasible widths."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model import transforms
from graspd.service.model.errors import HandError
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, quat_rotate
from graspd.worker.hands import closing, guess, jaws, kinematics, primitives, surface
from graspd.worker.hands.closing import closing_posture
from graspd.worker.hands.jaws import Pad, fingertip_pad
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.disk_cache import cached_arrays
from graspd.worker.objects.memory_cache import cached_by_content

#: Numbers of postures, of candidates per posture, and of random steps that improve the postures.
POSTURES: Final = 160
CROWD: Final = 25
CLIMBS: Final = 100
#: Least cosine of the line between pads with their normals, its largest cosine with the approach, least distance [m]
#: in front of the palm.
FACING: Final = 0.75
SQUARE: Final = 0.7
AHEAD_M: Final = 0.02
#: Least distance of opposed pads [m].
THINNEST_M: Final = 0.002
#: Difference of width [m] that costs as much as a decrease of `facing` by 1/3.
WIDTH_M: Final = 0.02
#: Standard deviations as shares of a range: of dofs that do not close, and of dofs of fingers that close together.
SIDEWAYS: Final = 0.15
UNEVEN: Final = 0.06
#: Numbers of surface points and random postures in the test whether a hand can hold any object.
_CHECKED_POINTS: Final = 512
_CHECKED_AT_RANDOM: Final = 11
#: Gap below which two surfaces hold nothing, and gap above which they hold no object that a hand can lift [m].
_GAP_M: Final = (0.004, 0.3)
#: Least cosine between a normal and the direction to the other surface: within 60 degrees.
_TOWARD: Final = 0.5
#: Least change of the gap between two surfaces that close [m].
_CLOSING_M: Final = 0.003


@dataclass(frozen=True)
class PinchPostures:
    """K postures in which pads of a hand face one another, sorted by width; root frame."""

    q: Floats  # (K, D)
    axis: Floats  # (K, 3) unit vector from the opposing finger's pad to the other pads
    middle: Floats  # (K, 3) midpoint [m]
    width: Floats  # (K,) gap, ascending [m]

    def __len__(self) -> int:
        return len(self.q)

    @property
    def widest(self) -> float:
        """Return the largest width [m]; 0 for a hand that cannot oppose its fingers."""
        return float(self.width[-1]) if len(self) else 0.0

    @classmethod
    def empty(cls, hand: HandModel) -> PinchPostures:
        return cls(np.zeros((0, hand.dofs)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))

    @classmethod
    def select(cls, q: Floats, seen: Any, good: NDArray[np.intp]) -> PinchPostures:
        """Select the rows `good` of postures and of their evaluation `seen`, sorted by width."""
        good = good[np.argsort(seen.width[good], kind="stable")]
        return cls(q[good], seen.axis[good], seen.middle[good], seen.width[good])

    @classmethod
    def load_or_search(
        cls, kind: str, key: tuple[str, ...], make: Callable[[], PinchPostures], *more: ModuleType
    ) -> PinchPostures:
        """Load postures from the disk cache, or make and cache them; modules `more` are part of the key."""
        return cls(**cached_arrays(kind, key, (*_code(), *more), lambda: vars(make())))


@cached_by_content(32)
def pinch_postures_of(hand: HandModel) -> PinchPostures:
    """Return the opposed postures of a hand, cached in memory and on disk; none for hands with one finger."""
    return PinchPostures.load_or_search("oppositions", (hand.content,), lambda: _search_postures(hand))


def _code() -> tuple[ModuleType, ...]:
    return (sys.modules[__name__], closing, guess, jaws, kinematics, primitives, surface, transforms)


def _search_postures(hand: HandModel) -> PinchPostures:
    if len(hand.fingertips) < 2:
        return PinchPostures.empty(hand)
    one = opposing_finger(hand)
    pads = [fingertip_pad(hand, body) for body in hand.fingertips]
    q = random_postures(hand, one, CROWD * POSTURES)
    seen = _PadGaps.measure(hand, pads, one, q)
    # Select the best of postures with similar widths, then improve it.
    order = np.argsort(seen.width, kind="stable").reshape(POSTURES, CROWD)
    q = q[order[np.arange(POSTURES), seen.cost(seen.width)[order].argmin(axis=1)]]
    wanted = np.linspace(THINNEST_M, np.quantile(seen.width, 0.98), POSTURES)
    q = improve_postures(hand, one, q, lambda tried: _PadGaps.measure(hand, pads, one, tried).cost(wanted))
    seen = _PadGaps.measure(hand, pads, one, q)
    faces = (seen.facing > FACING) & (seen.square < SQUARE)
    return PinchPostures.select(q, seen, np.flatnonzero(faces & (seen.width > THINNEST_M) & (seen.ahead > AHEAD_M)))


def opposing_finger(hand: HandModel) -> int:
    """Return the fingertip that opposes the others best, usually the thumb's."""
    pads = [fingertip_pad(hand, body) for body in hand.fingertips]
    costs = []
    for one in range(len(pads)):
        seen = _PadGaps.measure(hand, pads, one, random_postures(hand, one, POSTURES))
        costs.append(float(np.sort(seen.cost(seen.width))[: POSTURES // 4].mean()))
    return costs.index(min(costs))


@dataclass(frozen=True)
class _PadGaps:
    """Line from one finger's pad to the mean of the other pads in N postures; root frame."""

    axis: Floats
    middle: Floats
    width: Floats
    facing: Floats  # (N,) cosine of the pads' normals with the line between the pads; the lower value of both sides
    square: Floats  # (N,) absolute cosine of the palm's approach with the line between the pads
    ahead: Floats  # (N,) distance of the line's middle in front of the palm [m]

    @classmethod
    def measure(cls, hand: HandModel, pads: list[Pad], one: int, q: Floats) -> _PadGaps:
        tips = body_poses(hand, np.tile(IDENTITY_POSE, (len(q), 1)), hand.expand(q))[:, list(hand.fingertips)]
        place = apply(tips, np.array([p.centre for p in pads]))
        looks = quat_rotate(tips[..., 3:], np.array([p.normal for p in pads]))
        others = [f for f in range(len(pads)) if f != one]
        a, b = place[:, one], place[:, others].mean(axis=1)
        width = np.linalg.norm(b - a, axis=1)
        axis = (b - a) / np.maximum(width, 1e-9)[:, None]
        towards = -np.einsum("nfi,ni->nf", looks[:, others], axis).mean(axis=1)
        facing = np.minimum(np.einsum("ni,ni->n", looks[:, one], axis), towards)
        middle, approach = 0.5 * (a + b), hand.palm.approach
        square, ahead = np.abs(axis @ approach), (middle - hand.palm.centre) @ approach
        return cls(axis, middle, width, facing, square, ahead)

    def cost(self, wanted: Floats) -> Floats:
        """Return the cost (N,) of postures as oppositions of the widths `wanted` (N,)."""
        near = np.maximum(0.0, AHEAD_M + 0.01 - self.ahead) / WIDTH_M
        aside = 2 * np.maximum(0.0, self.square - 0.9 * SQUARE)
        return np.asarray(-3 * np.minimum(self.facing, 0.95) + np.abs(self.width - wanted) / WIDTH_M + near + aside)


def improve_postures(hand: HandModel, one: int, q: Floats, cost: Callable[[Floats], Floats]) -> Floats:
    """Decrease the `cost` (N,) of postures (N, D) by random steps of decreasing size."""
    rng = np.random.default_rng(one)
    finger, rank = _finger_ranks(hand)
    best = cost(q)
    for step in np.geomspace(0.3, 0.03, CLIMBS):
        together = np.where(hand.closing != 0, rng.standard_normal((len(q), rank.max() + 1))[:, rank], 0.0)
        noise = np.where(finger == one, rng.standard_normal((len(q), hand.dofs)), together)
        noise = noise * (rng.random(noise.shape) < 0.6)
        tried = np.clip(q + step * hand.span * noise, hand.lower, hand.upper)
        found = cost(tried)
        better = found < best
        q[better], best[better] = tried[better], found[better]
    return q


def random_postures(hand: HandModel, one: int, count: int) -> Floats:
    """Return postures (count, D): finger `one` is random; dofs of equal rank in others close alike."""
    rng = np.random.default_rng(one)
    finger, rank = _finger_ranks(hand)
    opened = np.where(hand.closing >= 0, hand.lower, hand.upper)
    closed = np.where(hand.closing >= 0, hand.upper, hand.lower)
    by_rank = rng.random((count, rank.max() + 1))[:, rank] + UNEVEN * rng.standard_normal((count, hand.dofs))
    alone = rng.random((count, hand.dofs))
    q = opened + np.clip(np.where(finger == one, alone, by_rank), 0, 1) * (closed - opened)
    aside = hand.preshape + SIDEWAYS * hand.span * rng.standard_normal((count, hand.dofs))
    still = (hand.closing == 0) & (finger != one)
    return np.asarray(np.where(still, np.clip(aside, hand.lower, hand.upper), q), float)


def _finger_ranks(hand: HandModel) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the finger (D,) of each dof: -1 if several fingers share the dof, -2 if it drives none.
    Also return the number of joints of that finger between the dof and the tip."""
    finger, rank = np.full(hand.dofs, -2, np.intp), np.zeros(hand.dofs, np.intp)
    for number, tip in enumerate(hand.fingertips):
        for seen, body in enumerate(hand.chain(tip)):
            dof = int(hand.dof[body])
            finger[dof] = number if finger[dof] in (-2, number) else -1
            rank[dof] = seen
    return finger, rank


def require_opposing(hand: HandModel) -> None:
    """Refuse a hand that cannot hold any object, before planning; cached in memory and on disk.
    Raises HandError: no two of its surfaces face each other and close; the message states the fix."""
    if _can_hold(hand):
        return
    shaped = {piece.body for piece in hand.pieces}
    bare = [hand.body_names[tip] for tip in hand.fingertips if tip not in shaped]
    if bare:
        raise HandError(
            f"{hand.name}: no two opposing digits: {', '.join(bare[:4])} have no collision shapes; add the fingers"
        )
    raise HandError.with_fixes(
        f"{hand.name}: no two opposing digits: no two surfaces face each other and close, so nothing can be held",
        "give the whole hand, or another --root",
        {"root": None},
    )


@cached_by_content(32)
def _can_hold(hand: HandModel) -> bool:
    made = cached_arrays("opposing", (hand.content,), _code(), lambda: {"opposes": np.array(can_oppose(hand))})
    return bool(made["opposes"])


def can_oppose(hand: HandModel) -> bool:
    """Check whether points on different bodies face each other in some posture over an adjustable gap."""
    points = sample_surface(hand, _CHECKED_POINTS)
    rng = np.random.default_rng(0)
    shares = [closing_posture(hand, share) for share in np.linspace(0, 1, 5)]
    q = np.concatenate([shares, rng.uniform(hand.lower, hand.upper, (_CHECKED_AT_RANDOM, hand.dofs))])
    poses = body_poses(hand, np.tile(IDENTITY_POSE, (len(q), 1)), hand.expand(q))[:, points.body]
    position, normal = apply(poses, points.position), quat_rotate(poses[..., 3:], points.normal)
    apart = points.body[:, None] != points.body[None]
    gaps = np.linalg.norm(position[0][:, None] - position[0][None], axis=2)
    least, most = gaps.copy(), gaps.copy()
    facing = np.zeros_like(apart)
    for at, outward in zip(position, normal, strict=True):
        found, gaps = _facing_mask(at, outward)
        facing |= found & apart
        np.minimum(least, gaps, out=least)
        np.maximum(most, gaps, out=most)
        if (facing & (most - least > _CLOSING_M)).any():
            return True
    return False


def _facing_mask(position: Floats, normal: Floats) -> tuple[np.ndarray, Floats]:
    """Return a mask (N, N) of pairs of points that face each other over a gap, and the gaps [m]."""
    way = position[None] - position[:, None]
    gap = np.linalg.norm(way, axis=2)
    toward = np.einsum("ijk,ik->ij", way, normal) > _TOWARD * gap
    return toward & toward.T & (gap > _GAP_M[0]) & (gap < _GAP_M[1]), gap
