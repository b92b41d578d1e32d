"""Antipodal starts: opposed fingers around two surface points, slightly farther apart than the points.

Two surface points with opposite normals are antipodal (Nguyen, "Constructing force-closure grasps", 1988). Pairs are
found by comparing samples of the surface with one another.

The distance by which a hand must rise to be clear of obstacles is computed from a few outline points per posture. This
costs less than the exact collision test, so many more hands can be tested.

Around a free object, hands also start at random pairs that are no wider than the hand opens (`ReachSampling`). In most
draws a finger or the palm penetrates the object. A test with balls inside the hand rejects such draws early.

A fingertip is modelled as a ball with the thickness of the hand's thinnest fingertip, next to an end of a pair. Space
for this ball is necessary for a grasp between opposed fingertips, but not sufficient."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.transforms import (
    IDENTITY_POSE,
    Floats,
    apply,
    quat_from_matrix,
    quat_rotate,
    spread_directions,
)
from graspd.worker.hands.flat_pinches import HEIGHTS_M, flat_pinches
from graspd.worker.hands.grasp_widths import Size, largest_width, postures_between, postures_for_size
from graspd.worker.hands.jaws import fingertip_pad, least_fingertip_width
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import PinchPostures, pinch_postures_of
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.region import WHOLE, ContactRegion
from graspd.worker.planners.fitting import region_points, surface_of
from graspd.worker.planners.requirements import INNER, NOTHING, Requirements
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.device import to_wxyz, to_xyzw
from graspd.worker.simulation.environment import CLEAR_M, Environment
from graspd.worker.simulation.kernels import reaching as kernels
from graspd.worker.simulation.launches import launch
from graspd.worker.simulation.model import Model
from graspd.worker.simulation.mounting import OUTERMOST, mounting_points
from graspd.worker.simulation.obstacles import MARGIN_M

#: Least cosine between a pair's line and its normals. Such lines are inside the friction cones at half friction. Share
#: of grasps on six objects that lift at half friction, with 0.9: Allegro .39, Shadow .30; with 0.96: Allegro .42,
#: Shadow .39.
ACROSS: Final = 0.96
#: Least distance of the two points [m].
THINNEST_M: Final = 0.002
#: Least and largest clearance between pad and object, on each side [m].
ROOM_M: Final = (0.003, 0.015)
#: Horizontal distance from the centre of mass at which the probability of a pair falls by a factor of e [m], and least
#: factor. A factor `SELDOM` applies to pairs hard to reach or with a cosine to the vertical above `STEEP`. Share
#: of Allegro grasps on six objects that hold at half friction: .28 with 30 mm and a least factor of .02, else .38.
BESIDE_M: Final = 0.02
FAR: Final = 0.005
STEEP: Final = 0.5
SELDOM: Final = 0.1
#: Largest distance of the pads from the ends of the pair at which a draw counts as close enough [m].
NEAR_M: Final = 0.008
#: Number of hands whose draws are compared at once; a larger number needs more memory and saves no time.
AT_ONCE: Final = 256
#: Least cosine between an approach from above and the vertical, for flat objects.
UPRIGHT: Final = 0.9
#: Noise of the posture as a share of each joint's range, and number of directions compared per draw. Amounts by which a
#: posture may be narrower and wider than the drawn width [m].
NOISE: Final = 0.03
WAYS: Final = 4
ALIKE_M: Final = (0.002, 0.006)


@dataclass(frozen=True)
class Crossings:
    """P pairs of opposite surface points: middle (P, 3) [m], axis (P, 3), width (P,) [m]."""

    middle: Floats
    axis: Floats
    width: Floats

    def __len__(self) -> int:
        return len(self.width)

    def ends(self) -> tuple[Floats, Floats]:
        half = 0.5 * self.width[:, None] * self.axis
        return self.middle - half, self.middle + half


@cached_by_content(16)
def crossings_of(obj: ObjectModel, region: ContactRegion = WHOLE) -> Crossings:
    place, face = region_points(obj, region)
    normal = surface_of(obj)[1][face]
    line = place[None] - place[:, None]
    width = np.linalg.norm(line, axis=-1)
    unit = line / np.maximum(width, 1e-9)[..., None]
    leaves = -np.einsum("ijk,ik->ij", unit, normal)
    enters = np.einsum("ijk,jk->ij", unit, normal)
    i, j = np.nonzero(np.triu((np.minimum(leaves, enters) > ACROSS) & (width > THINNEST_M), 1))
    return Crossings(0.5 * (place[i] + place[j]), unit[i, j], width[i, j])


@dataclass(frozen=True)
class Openings:
    """Pairs in one scene that a hand may grasp."""

    pairs: Crossings
    sums: Floats
    """(P,) cumulative probability; empty if no pair fits."""
    known: PinchPostures
    up: Floats
    """(3,) direction against gravity, object frame."""
    upright: bool
    """Whether the hand approaches from above and grasps only level pairs."""
    within_reach: bool
    """Whether a pair is nearly level, clear of obstacles, and no wider than the hand opens.
    This is the geometric condition for a grasp between opposed fingers from above or from the side."""
    at_pads: bool = False
    """Whether all pairs are between the pads, never nearer to the palm."""

    @classmethod
    def of(
        cls,
        known: PinchPostures,
        obj: ObjectModel,
        scene: Environment,
        *,
        tip: float = 0.0,
        upright: bool = False,
        wanted: Requirements = NOTHING,
    ) -> Openings:
        """Select pairs narrow enough for the hand; favour pairs with space for fingertips `tip` thick [m]."""
        pairs = crossings_of(obj, wanted.region)
        level = np.abs(pairs.axis @ scene.up) < STEEP
        fits = pairs.width + 2 * ROOM_M[0] <= known.widest
        if upright:
            flat = pairs.axis - (pairs.axis @ scene.up)[:, None] * scene.up
            length = np.linalg.norm(flat, axis=1, keepdims=True)
            pairs, fits = replace(pairs, axis=flat / np.maximum(length, 1e-9)), fits & level
        if not fits.any():
            return cls(pairs, np.zeros(0), known, scene.up, upright, False, wanted.by_pads)
        aside = pairs.middle - obj.centre_of_mass
        aside = aside - (aside @ scene.up)[:, None] * scene.up
        chance = np.exp(-((np.linalg.norm(aside, axis=1) / BESIDE_M) ** 2)) + FAR
        room = np.full(len(pairs), np.inf)
        for obstacle in scene.obstacles:
            for end in pairs.ends():
                room = np.minimum(room, obstacle.distance(end))
        easy = (room >= MARGIN_M) & (end_clearance(pairs, scene, tip) >= 0.0)
        chance *= np.where(level, 1.0, SELDOM) * np.where(easy, 1.0, SELDOM) * fits
        within_reach = bool((fits & easy & level).any())
        return cls(pairs, np.cumsum(chance) / chance.sum(), known, scene.up, upright, within_reach, wanted.by_pads)

    @classmethod
    def in_scene(
        cls, hand: HandModel, obj: ObjectModel, scene: Environment, wanted: Requirements = NOTHING
    ) -> Openings:
        """Select pairs for fingertips that rest beside a flat object; if none fits, for the pads."""
        ends = flat_pinches(hand, float(np.ptp(obj.hull_vertices @ scene.up)))
        tip = least_fingertip_width(hand)
        flat = cls.of(ends, obj, scene, tip=tip, upright=True, wanted=wanted)
        return flat if len(flat.sums) else cls.of(pinch_postures_of(hand), obj, scene, tip=tip, wanted=wanted)


def end_clearance(pairs: Crossings, scene: Environment, width: float) -> Floats:
    """Return the least clearance (P,) of balls of diameter `width` at the ends of pairs [m].
    Walls and neighbours count; half-spaces that face upwards, such as the table, are ignored."""
    out = np.full(len(pairs), np.inf)
    for obstacle in scene.obstacles:
        if not len(obstacle.corners) and float(obstacle.planes[0, :3] @ scene.up) > STEEP:
            continue
        for end, side in zip(pairs.ends(), (-0.5, 0.5), strict=True):
            out = np.minimum(out, obstacle.distance(end + side * width * pairs.axis) - 0.5 * width)
    return out


@dataclass(frozen=True)
class AntipodalHands:
    """n hands with fingers on both sides of the object; rotations `turn`, retreat directions `away`."""

    known: PinchPostures
    posture: NDArray[np.intp]
    """(n,) indices into `known`."""
    pivot: Floats
    """(n, 3) palm centres relative to the object's centre of mass [m]."""
    turn: Floats
    away: Floats
    deep: Floats
    """(n,) distance of the pads beyond the pair [m]; a larger distance brings the palm nearer to the object."""

    def q(self, hand: HandModel, normal: Floats) -> Floats:
        known = self.known.q[self.posture]
        return np.clip(known + NOISE * hand.span * normal, hand.lower, hand.upper)

    def pad_distance(self, moved: Floats) -> Floats:
        """Return the distance (n, ...) of the pair from the pads after motions `moved` (n, ..., 3) [m].
        Distance towards the palm does not count, since such a pair is also between the fingers."""
        away = self.away.reshape(len(self.deep), *(1,) * (moved.ndim - 2), 3)
        off = moved - self.deep.reshape((*away.shape[:-1], 1)) * away
        along = np.einsum("n...i,ni->n...", off, self.away)
        return np.linalg.norm(off - np.minimum(along, 0.0)[..., None] * away, axis=-1)


def place_antipodal_hands(
    hand: HandModel, obj: ObjectModel, opening: Openings, uniform: Floats, ways: Floats
) -> AntipodalHands:
    """Place hands across pairs by random numbers (n, 6); `ways` (K, 3) are free directions of retreat."""
    known = opening.known
    if opening.upright and (upright := ways @ opening.up > UPRIGHT).any():
        ways = ways[upright]
    pair = np.minimum(np.searchsorted(opening.sums, uniform[:, 0]), len(opening.sums) - 1)
    axis = opening.pairs.axis[pair] * np.where(uniform[:, 1] < 0.5, 1.0, -1.0)[:, None]
    width = opening.pairs.width[pair] + 2 * (ROOM_M[0] + (ROOM_M[1] - ROOM_M[0]) * uniform[:, 2])
    low = np.searchsorted(known.width, width - ALIKE_M[0])
    high = np.maximum(np.searchsorted(known.width, width + ALIKE_M[1]), low + 1)
    posture = np.minimum(low + (uniform[:, 3] * (high - low)).astype(int), len(known) - 1)
    # Among a few free directions, choose the one most nearly perpendicular to the pair's line.
    share = (uniform[:, 4:5] + np.arange(WAYS) * 0.6180339887) % 1.0
    tried = ways[(share * len(ways)).astype(int)]
    best = np.abs(np.einsum("nki,ni->nk", tried, axis)).argmin(axis=1)
    palm = np.tile(hand.palm.approach, (len(pair), 1))
    turn = frames_from_axes(axis, -tried[np.arange(len(tried)), best]) @ np.swapaxes(
        frames_from_axes(known.axis[posture], palm), -1, -2
    )
    away = -np.einsum("nij,nj->ni", turn, palm)
    reach = known.middle[posture] - hand.palm.centre
    # The depth ranges from a fingertip grasp to a palm in contact with the object.
    deep = np.maximum(np.einsum("ni,ni->n", reach, palm), 0.0) * uniform[:, 5] * (not opening.at_pads)
    pivot = opening.pairs.middle[pair] - np.einsum("nij,nj->ni", turn, reach) - deep[:, None] * away
    return AntipodalHands(known, posture, pivot - obj.centre_of_mass, turn, away, deep)


def select_draws(
    hand: HandModel,
    obj: ObjectModel,
    opening: Openings,
    uniform: Floats,
    ways: Floats,
    scene: Environment,
    *,
    room: float,
    keep: int,
) -> tuple[NDArray[np.intp], Floats]:
    """Select `keep` of C draws per hand: those with pads nearest to the pair after rising off obstacles.
    Return their indices and the distance of the pair from the pads (n, keep) [m]. Draws below `NEAR_M` keep their
    order. For `uniform` (n, C, 6) and `ways` see `place_antipodal_hands`; `room` [m] adds to the margin."""
    count, draws, _ = uniform.shape
    outlines, off = posture_outlines(hand, opening.known.q), np.zeros((count, draws))
    for rows in np.array_split(np.arange(count), 1 + count // AT_ONCE):
        found = place_antipodal_hands(hand, obj, opening, uniform[rows].reshape(-1, 6), ways)
        lack = outlines.missing_clearance(found.posture, found.turn, found.pivot + obj.centre_of_mass, scene, room=room)
        off[rows] = found.pad_distance(lack[:, None] * scene.up).reshape(-1, draws)
    order = np.argsort(np.maximum(off, NEAR_M), axis=1, kind="stable")[:, :keep]
    return order, np.take_along_axis(off, order, axis=1)


def frames_from_axes(first: Floats, second: Floats) -> Floats:
    """Return rotations (n, 3, 3) with first column `first` (n, 3) and second column closest to `second`."""
    y = second - np.einsum("ni,ni->n", first, second)[:, None] * first
    helper = np.eye(3)[np.argmin(np.abs(first), axis=1)]
    other = helper - np.einsum("ni,ni->n", first, helper)[:, None] * first
    y = np.where(np.linalg.norm(y, axis=1, keepdims=True) > 1e-3, y, other)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.stack([first, y, np.cross(first, y)], axis=-1)


#: Number of outermost points of the fingertips, and of the rest of the hand.
DIRECTIONS: Final = 20


@dataclass(frozen=True)
class PostureOutlines:
    """Outermost points of a hand in each of its K opposed postures, relative to the palm's centre."""

    points: Floats
    tips: NDArray[np.bool_]
    """(P,) mask of the fingertips' points."""
    mounting: Floats
    """(W, M, 3) outermost points of the mounting at each wrist position, from the palm's centre [m].
    W is 0 without a mounting."""

    def missing_clearance(
        self, posture: NDArray[np.intp], turn: Floats, centre: Floats, scene: Environment, *, room: float
    ) -> Floats:
        """Return by how much (n,) hands and mountings miss the margin plus `room` [m]; at least 0.
        Hands have postures (n,), rotations (n, 3, 3) and palm centres (n, 3), object frame [m]."""
        place = np.matmul(self.points[posture], np.swapaxes(turn, -1, -2)) + centre[:, None]
        lack = np.zeros(len(posture))
        for obstacle in scene.obstacles:
            wanted = np.where(self.tips, MARGIN_M if obstacle.tips_m is None else obstacle.tips_m, MARGIN_M) + room
            lack = np.maximum(lack, (wanted - obstacle.distance(place)).max(axis=1))
        return np.maximum(lack, self._missing_mounting_clearance(turn, centre, scene, MARGIN_M + room))

    def _missing_mounting_clearance(self, turn: Floats, centre: Floats, scene: Environment, wanted: float) -> Floats:
        """Return by how much (n,) mountings miss clearance `wanted` at their best wrist position [m]."""
        least = np.full(len(turn), np.inf if len(self.mounting) else 0.0)
        for points in self.mounting:
            rows = np.flatnonzero(least > 0.0)
            place = points @ np.swapaxes(turn[rows], -1, -2) + centre[rows, None]
            lack = [(wanted - obstacle.distance(place)).max(axis=1) for obstacle in scene.obstacles]
            least[rows] = np.minimum(least[rows], np.maximum.reduce([*lack, np.zeros(len(rows))]))
        return least


@cached_by_content(16)
def posture_outlines(hand: HandModel, q: Floats) -> PostureOutlines:
    bodies = body_poses(hand, np.tile(IDENTITY_POSE, (len(q), 1)), hand.expand(q))
    points, tips = [], []
    for tip in (True, False):
        solid = [apply(bodies[:, p.body, None], p.vertices) for p in hand.pieces if (p.body in hand.fingertips) == tip]
        if solid:
            corners = np.concatenate(solid, axis=1)
            far = (corners @ spread_directions(DIRECTIONS).T).argmax(axis=1)
            points.append(np.take_along_axis(corners, far[..., None], axis=1))
            tips.append(np.full(DIRECTIONS, tip))
    mounting = np.zeros((0, 0, 3))
    if hand.mounting is not None:
        mounting = mounting_points(hand.mounting)[:, :OUTERMOST] - hand.palm.centre
    return PostureOutlines(np.concatenate(points, axis=1) - hand.palm.centre, np.concatenate(tips), mounting)


#: Largest gap that is measured, and resolution of smaller gaps [m].
WIDEST_M: Final = 0.064
EXACT_M: Final = 0.0005


def narrow_reason(hand: HandModel, obj: ObjectModel, scenes: Sequence[Environment]) -> str | None:
    """Explain why fingertips of a hand cannot hold an object in any scene; None if no reason is found."""
    known, pairs = pinch_postures_of(hand), crossings_of(obj)
    if not len(known) or not len(pairs):
        return None
    fits = pairs.width <= known.widest
    if not fits.any():
        return (
            f"opposite sides of {obj.name} are at least {1e3 * pairs.width.min():.0f} mm apart, and {hand.name} opens "
            f"to {1e3 * known.widest:.0f} mm"
        )
    height = max(float(np.ptp(obj.hull_vertices @ scene.up)) for scene in scenes)
    if height <= HEIGHTS_M[-1] and not len(flat_pinches(hand, height)):
        return (
            f"{obj.name} is {1e3 * height:.0f} mm high: fingertips of {hand.name} that rest beside it face each "
            "other only at a larger height"
        )
    thin = least_fingertip_width(hand)
    gap = max(_widest_gap(pairs, fits, scene, thin) for scene in scenes)
    if gap >= thin + CLEAR_M:
        return None
    return (
        f"the gap beside {obj.name} is about {1e3 * gap:.0f} mm wide; the thinnest fingertip of {hand.name} needs "
        f"{1e3 * thin:.0f} mm and a clearance of {1e3 * CLEAR_M:.0f} mm"
    )


def _widest_gap(pairs: Crossings, fits: NDArray[np.bool_], scene: Environment, thin: float) -> float:
    """Return the largest diameter of balls next to both ends of a pair [m]; steep pairs need space below."""
    level, above = np.abs(pairs.axis @ scene.up) < STEEP, np.ones(len(pairs), bool)
    for obstacle in scene.obstacles:
        above &= np.minimum(*(obstacle.distance(end) for end in pairs.ends())) >= thin
    rows = fits & (level | above)
    if not rows.any():
        return 0.0
    pairs = Crossings(pairs.middle[rows], pairs.axis[rows], pairs.width[rows])
    low, high = 0.0, WIDEST_M
    while high - low > EXACT_M:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if end_clearance(pairs, scene, middle).max() >= 0.0 else (low, middle)
    return low


#: Largest number of draws per start, and of draws that pass the ball test and are then tested exactly.
DRAWS: Final = 512
LOOKS: Final = 8
#: Probability of a pair far from the centre of mass, relative to a pair through it.
FAR_ACROSS: Final = 0.05
#: Half the width of a palm for the pairs within reach along an approach cone [m].
PALM_M: Final = 0.02
#: Number of balls in the hand, and their radius [m]. They touch its surface from inside and protrude from thin links.
BALLS: Final = 96
BALL_M: Final = 0.005
#: An object is small if all its pairs are narrower than this [m] and than the smallest gap of the hand's pads.
SMALL_M: Final = 0.017
#: Largest distance of a pad from the object, in addition to half the clearance, where fingers are in line [m].
ROW_M: Final = 0.006
#: Error of the grid's distances [m].
SLACK_M: Final = 0.001


@dataclass(frozen=True)
class ReachSampling:
    model: Model
    grips: Any
    only: bool
    """Whether all starts are antipodal: in an approach cone, or if the object is too small or too wide for the pads, or
    its region thin. Starts with the palm towards a random point then rarely succeed. In a cone of 30 degrees from
    above, Shadow needs 1.6 to 2 times as many attempts with them (mug, bottle)."""

    @classmethod
    def of(cls, model: Model, wanted: Requirements = NOTHING) -> ReachSampling | None:
        """Create the sampling; None without opposed fingers, or if the object is too wide everywhere."""
        known = _grips(model.hand.model, model.obj.model, model.device, wanted)
        return None if known is None else cls(model, *known)

    def starts(self, seeds: NDArray[np.int32], first: NDArray[np.int32], retreats: Floats) -> tuple[HandState, Any]:
        """Return each start's first draw that passes the ball test, from draw number `first` (n,) on.
        Also return the draws' numbers (n,), -1 if none passes. `retreats` are ascending distances [m]."""
        m, count = self.model, len(seeds)
        with wp.ScopedDevice(m.device):
            number = wp.empty(count, dtype=wp.int32)
            pivot, rotation = wp.zeros(count, dtype=wp.vec3), wp.zeros(count, dtype=wp.quat)
            q = wp.zeros((count, m.dofs), dtype=wp.float32)
            draws = [wp.array(numbers, dtype=wp.int32) for numbers in (seeds, first)]
            inputs = [m.obj.surface, self.grips, *draws, DRAWS, wp.vec2(*ALIKE_M), wp.vec2(*ROOM_M)]
            inputs.append(wp.array(retreats, dtype=wp.float32))
            launch(kernels.reach, count, inputs=inputs, outputs=[number, pivot, rotation, q])
        found = HandState(pivot.numpy().astype(float), to_wxyz(rotation.numpy().astype(float)), q.numpy().astype(float))
        return found, number.numpy()


def classify_size(hand: HandModel, width: Floats) -> Size | None:
    """Classify an object of pair widths (P,) as too small or too wide for the pads; None if neither."""
    known = pinch_postures_of(hand)
    if not len(known) or not len(width):
        return None
    if width.max() < min(SMALL_M, known.width[0]):
        return "small"
    return "wide" if width.min() + 2 * ROOM_M[0] > known.widest else None


def _postures(hand: HandModel, width: Floats, size: Size | None) -> PinchPostures:
    """Return postures for pairs of these widths (P,); empty if no posture fits a pair."""
    if size == "wide" and width.min() + 2 * ROOM_M[0] > largest_width(hand):
        return PinchPostures.empty(hand)
    known = pinch_postures_of(hand) if size is None else postures_for_size(hand, size)
    return known if (width + 2 * ROOM_M[0] <= known.widest).any() else PinchPostures.empty(hand)


@cached_by_content(8)
def _grips(hand: HandModel, obj: ObjectModel, device: str, wanted: Requirements) -> tuple[Any, bool] | None:
    """Return `ReachSampling.grips` and `.only`; None if no posture fits a pair."""
    pairs, out = crossings_of(obj, wanted.region), kernels.Grips()
    size = classify_size(hand, pairs.width)
    if size is None and wanted.region.touch is not None and len(pairs) and np.median(pairs.width) < SMALL_M:
        size = "small"  # a thin part, such as a handle: a palm towards it would meet the rest of the object
    if (parts := wanted.opposed_parts(hand)) is not None:
        known, size = postures_between(hand, *parts), "small"
    else:
        known = _postures(hand, pairs.width, size)
    if not len(known):
        return None
    kept = np.flatnonzero(pairs.width + 2 * ROOM_M[0] <= known.widest)
    middle = pairs.middle[kept] - obj.centre_of_mass
    chance = np.exp(-((np.linalg.norm(middle, axis=1) / BESIDE_M) ** 2)) + FAR_ACROSS
    if wanted.approach is not None:
        longest = float(np.linalg.norm(known.middle - hand.palm.centre, axis=1).max())
        chance *= _is_within_reach(obj, middle, -wanted.approach, longest)
    points = sample_surface(hand, BALLS)
    pose = body_poses(hand, np.tile(IDENTITY_POSE, (len(known), 1)), hand.expand(known.q))[:, points.body]
    balls = quat_rotate(pose[..., 3:], points.position - BALL_M * points.normal) + pose[..., :3] - hand.palm.centre
    own = quat_from_matrix(frames_from_axes(known.axis, np.tile(hand.palm.approach, (len(known), 1))))
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
        pads = _pads(hand, known) if wanted.in_row else np.zeros((len(known), 0, 3))
        out.pads = wp.array(pads, dtype=wp.vec3, ndim=2)
        out.beyond = ROW_M
        # Objects that are too small or too wide are held between the pads, never nearer to the palm.
        at_pads = bool(size) or wanted.by_pads
        out.deep = 0.0 if at_pads else 1.0
        out.cone_axis = wp.vec3(*(np.zeros(3) if wanted.approach is None else wanted.approach))
        out.cone_cos = -1.0 if wanted.approach is None else float(np.cos(INNER * wanted.cone))
        out.palm = wp.vec3(*hand.palm.approach)
        out.noise = wp.array(NOISE * hand.span, dtype=wp.float32)
        out.lower, out.upper = wp.array(hand.lower, dtype=wp.float32), wp.array(hand.upper, dtype=wp.float32)
    return out, at_pads or wanted.approach is not None


def _pads(hand: HandModel, known: PinchPostures) -> Floats:
    """Return the centres of the fingertips' pads (K, F, 3) in each posture, from the palm's centre [m]."""
    tips = list(hand.fingertips)
    pose = body_poses(hand, np.tile(IDENTITY_POSE, (len(known), 1)), hand.expand(known.q))[:, tips]
    return np.asarray(apply(pose, np.array([fingertip_pad(hand, tip).centre for tip in tips])) - hand.palm.centre)


def _is_within_reach(obj: ObjectModel, middle: Floats, back: Floats, longest: float) -> NDArray[np.bool_]:
    """Return a mask (P,) of pairs with less object than `longest` [m] behind them, along `back` (3,).
    `middle` (P, 3) is relative to the centre of mass [m]. All pairs, if there is none."""
    from scipy.spatial.distance import cdist  # only cones need it

    surface = region_points(obj, WHOLE)[0] - obj.centre_of_mass
    above = surface @ back - (middle @ back)[:, None]
    beside = cdist(middle - np.outer(middle @ back, back), surface - np.outer(surface @ back, back)) < PALM_M
    inside = np.where(beside, above, 0.0).max(axis=1) < longest
    return inside if inside.any() else ~inside
