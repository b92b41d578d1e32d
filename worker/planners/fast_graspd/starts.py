"""Starts of hands around a free object.

In every second start of a grasp the palm faces a random surface point. The other starts are antipodal
(`ReachSampling`). All are antipodal in an approach cone, or if the object is too small or too wide for the pads.

A start must not penetrate the object deeply, since hands that start inside a thin wall never leave it.

For a gripper a pair of opposite surface points is drawn. The jaws open slightly wider than the pair and are placed
around it, at a random angle about the line through the points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import (
    Floats,
    cross,
    quat_from_axis_angle,
    quat_from_matrix,
    quat_multiply,
    quat_rotate,
)
from graspd.worker.hands.jaws import Jaws, jaws_of
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.mesh_geometry import points_on_triangles
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.antipodal_starts import LOOKS, ReachSampling
from graspd.worker.planners.fitting import Pairs, fitting_pairs, region_points
from graspd.worker.planners.requirements import INNER, NOTHING, Requirements
from graspd.worker.simulation.data import Data, HandState
from graspd.worker.simulation.model import Model
from graspd.worker.simulation.record import record_placement

#: Nearest and farthest distance of the palm from the surface; retreats of hands that are not clear [m].
GAP: Final = (0.002, 0.012)
RETREATS: Final = (0.0, 0.01, 0.02, 0.03)
#: Nearest and farthest distance of the palm for hands that open further than their pre-shape [m].
OPENED_GAP: Final = (0.004, 0.02)
#: Tilt of the approach away from the surface normal, standard deviation [rad].
TILT: Final = 0.25
#: Noise of the pre-shape, standard deviation as a share of the joint's range.
POSTURE_NOISE: Final = 0.08
#: Noise of starts about a demonstrated wrist pose, standard deviations along and about each axis [m, rad].
LIKE_NOISE: Final = (0.01, float(np.deg2rad(10.0)))
#: Largest penetration at which a draw counts as clear [m].
CLEAR: Final = 0.001
#: Draws per start before the least penetrating one is selected.
DRAWS: Final = 48
#: Openings of hands that find no start in their pre-shape, as shares of the remaining range; draws at each opening.
OPENED: Final = (0.5, 1.0)
OPENED_DRAWS: Final = 24
#: Depth above which a start is rejected [m].
NO_PLACE: Final = 0.01


def start_generator(seed: int, batch: int, index: int, start: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence([seed, batch, index, start]))


def frames_about(z: Floats) -> Floats:
    """Return rotations (..., 3, 3) with third columns z (..., 3) and arbitrary but fixed first columns."""
    helper = np.eye(3)[np.argmin(np.abs(z), axis=-1)]
    x = cross(helper, z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, cross(z, x), z], axis=-1)


class _Pair:
    """Data that all draws of a hand around an object share; `gap` [m] is the range of the palm's distance."""

    def __init__(
        self, hand: HandModel, obj: ObjectModel, gap: tuple[float, float] = GAP, wanted: Requirements = NOTHING
    ) -> None:
        self.hand, self.centre, self.gap, self.wanted = hand, obj.centre_of_mass, gap, wanted
        self.corners = obj.vertices[obj.faces]
        #: Normals (F, 3) of the faces; their length is twice the area [m^2].
        self.across = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        self.area = np.linalg.norm(self.across, axis=1)
        self.places: tuple[Floats, Floats] | None = None
        """Points (P, 3) that grasps may touch and their normals (P, 3), with a contact region."""
        if not wanted.region.is_whole:
            point, face = region_points(obj, wanted.region)
            self.places = point, self.across[face] / self.area[face, None]
        share = np.cumsum(self.area / self.area.sum())
        self.share = share / share[-1]
        self.palm = frames_about(hand.palm.approach).T


def _numbers(generators: list[np.random.Generator], dofs: int) -> tuple[Floats, Floats]:
    """Return the random numbers of n draws.
    Uniform (n, 5): face, point (two numbers), roll, gap. Normal (n, 2 + D): tilt, then noise of the pre-shape."""
    uniform, normal = np.empty((len(generators), 5)), np.empty((len(generators), 2 + dofs))
    for i, rng in enumerate(generators):
        uniform[i, :3] = rng.random(3)
        normal[i, :2] = rng.standard_normal(2)
        uniform[i, 3] = rng.random()
        normal[i, 2:] = rng.standard_normal(dofs)
        uniform[i, 4] = rng.random()
    return uniform, normal


def draw_starts(pair: _Pair, generators: list[np.random.Generator]) -> tuple[HandState, Floats]:
    """Draw one start per generator, before any retreat; also return the palms' approaches (n, 3)."""
    if pair.wanted.like is not None:
        noise = np.array([rng.standard_normal(6 + pair.hand.dofs) for rng in generators])
        return draw_at_pose(pair.hand, pair.centre, pair.wanted.like, noise)
    hand, (uniform, noise) = pair.hand, _numbers(generators, pair.hand.dofs)
    face = pair.share.searchsorted(uniform[:, 0], side="right")
    point = points_on_triangles(pair.corners[face], uniform[:, 1:2], uniform[:, 2:3])
    normal = pair.across[face] / pair.area[face, None]
    if pair.places is not None:
        chosen = (uniform[:, 0] * len(pair.places[0])).astype(int)
        point, normal = pair.places[0][chosen], pair.places[1][chosen]
    if pair.wanted.approach is not None:
        normal = -into_cone(-normal, pair.wanted.approach, pair.wanted.cone)
    tilt = np.einsum("nij,nj->ni", frames_about(normal)[..., :2], noise[:, :2])
    length = np.linalg.norm(tilt, axis=1, keepdims=True)
    angle = np.where(length * TILT > 1e-9, length * TILT, 0.0)
    normal = normal * np.cos(angle) + cross(tilt / np.maximum(length, 1e-12), normal) * np.sin(angle)
    approach = -normal
    if pair.wanted.approach is not None:
        approach = into_cone(approach, pair.wanted.approach, INNER * pair.wanted.cone)
    roll = quat_from_axis_angle(approach, 2 * np.pi * uniform[:, 3])
    rotation = quat_multiply(roll, quat_from_matrix(frames_about(approach) @ pair.palm))
    q = hand.preshape + POSTURE_NOISE * (hand.upper - hand.lower) * noise[:, 2:]
    near, far = pair.gap
    pivot = point - pair.centre - approach * (near + (far - near) * uniform[:, 4:])
    return HandState(pivot, rotation, np.clip(q, hand.lower, hand.upper)), approach


def draw_at_pose(hand: HandModel, centre: Floats, pose: Floats, noise: Floats) -> tuple[HandState, Floats]:
    """Return hands around a wrist pose (7,), and their approaches (n, 3).
    The random numbers `noise` (n, 6 + D) are normal; `centre` (3,) is the object's centre of mass."""
    turn = LIKE_NOISE[1] * noise[:, 3:6]
    angle = np.linalg.norm(turn, axis=1)
    rotation = quat_multiply(quat_from_axis_angle(turn / np.maximum(angle, 1e-12)[:, None], angle), pose[3:])
    pivot = pose[:3] + LIKE_NOISE[0] * noise[:, :3] - centre + quat_rotate(rotation, hand.palm.centre)
    q = np.clip(hand.preshape + POSTURE_NOISE * hand.span * noise[:, 6:], hand.lower, hand.upper)
    return HandState(pivot, rotation, q), quat_rotate(rotation, hand.palm.approach)


def into_cone(approach: Floats, axis: Floats, angle: float) -> Floats:
    """Turn unit vectors (n, 3) outside the cone about `axis` (3,) to an angle inside [rad].
    An angle of a above `angle` becomes `angle` a / pi, so that the directions stay different from each other."""
    cosine = approach @ axis
    between = np.arccos(np.clip(cosine, -1.0, 1.0))
    aside = approach - cosine[:, None] * axis
    length = np.linalg.norm(aside, axis=1, keepdims=True)
    aside = np.where(length > 1e-9, aside / np.maximum(length, 1e-9), frames_about(axis)[:, 0])
    turned = np.where(between > angle, angle * between / np.pi, between)[:, None]
    return np.asarray(np.cos(turned) * axis + np.sin(turned) * aside)


def _retreats(state: HandState, approach: Floats) -> HandState:
    back = np.array(RETREATS)[None, :, None]
    return hands_at_distances(state.pivot[:, None] - back * approach[:, None], state.rotation, state.q)


def hands_at_distances(pivot: Floats, rotation: Floats, q: Floats) -> HandState:
    """Return hands (n * K) at pivots (n, K, 3), with rotations (n, 4) and dofs (n, D)."""
    each = pivot.shape[1]
    return HandState(pivot.reshape(-1, 3), np.repeat(rotation, each, axis=0), np.repeat(q, each, axis=0))


class Probe:
    """Places hands and measures depth and distance from the object; for `room` see `record_placement`."""

    def __init__(self, model: Model, capacity: int, *, room: float = 0.0) -> None:
        self.model, self.data = model, Data(model, capacity)
        self.band = model.options.band
        self._touching = record_placement(model, self.data, room=room, within=0.0)
        self._placement = record_placement(model, self.data, room=room)

    def depths(self, states: HandState) -> Floats:
        """Return the deepest penetration of each hand (n,) [m].
        It covers hand in object, object in links, links in links, and missing clearance from obstacles."""
        self.data.set_state(states)
        self._touching.run()
        return self.data.deepest_penetration(len(states.pivot)).astype(float)

    def nearest(self, states: HandState) -> Floats:
        """Return each hand's least distance (n,) from the object [m], at most `LossOptions.band`."""
        self.data.set_state(states)
        self._placement.run()
        n = len(states.pivot)
        counts = self.data.contacts.count.numpy()[:n]
        distances = self.data.contacts.distance.numpy()[:n]
        present = np.arange(distances.shape[1]) < counts[:, None]
        return np.where(present, distances, self.band).min(axis=1).clip(0.0, self.band).astype(float)


def sample_starts(model: Model, *, seed: int, batch: int, indices: range, each: int) -> HandState:
    """Sample starts of the grasps `indices` of a batch; the `each` starts of a grasp are adjacent.
    Raises InputError: every draw of some start penetrates by more than `NO_PLACE`."""
    generators = [start_generator(seed, batch, i, k) for i in indices for k in range(each)]
    state, depth = clear_starts(model, generators, each=each)
    open_further(model, generators, state, depth, np.ones(len(depth), bool))
    if depth.max() > NO_PLACE:
        raise no_start_error(model)
    return state


def no_start_error(model: Model, wanted: Requirements = NOTHING) -> InputError:
    hand, obj = model.hand.model, model.obj.model
    if wanted.like is not None:
        return InputError(
            f"{hand.name} penetrates {obj.name} at the demonstrated wrist pose: give it in metres in the object's frame"
        )
    return InputError(
        f"{hand.name} finds no free place around {obj.name}: the object is too large or encloses the hand; "
        "check the object's units"
    )


def clear_starts(
    model: Model, generators: list[np.random.Generator], *, each: int = 1, wanted: Requirements = NOTHING
) -> tuple[HandState, Floats]:
    """Return each generator's first clear start, or else its least deep one, and their depths (n,) [m].
    The second, fourth, ... of the `each` starts of a grasp are antipodal if possible, or all (`ReachSampling.only`)."""
    hand, obj = model.hand.model, model.obj.model
    count, jaws = len(generators), JawStarts.of(hand, obj, wanted) if wanted.like is None else None
    retreats = RETREATS if jaws is None else JAW_RETREATS
    probe = Probe(model, count * len(retreats))
    pair = _Pair(hand, obj, wanted=wanted)
    best = HandState(np.zeros((count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)), np.zeros((count, hand.dofs)))
    deepest = np.full(count, np.inf)
    if jaws is None and wanted.like is None and each > 1 and (reaching := ReachSampling.of(model, wanted)) is not None:
        rows = np.arange(count)
        _draw_antipodal(
            reaching, generators, rows if reaching.only else rows[rows % each % 2 == 1], probe, best, deepest
        )

    def drawn(rows: NDArray[np.intp]) -> HandState:
        if jaws is None:
            return _retreats(*draw_starts(pair, [generators[i] for i in rows]))
        return jaws.draw(np.array([generators[i].random(UNIFORM) for i in rows]))

    _draw_until_clear(drawn, probe, DRAWS, np.flatnonzero(deepest > CLEAR), best, deepest)
    return best, deepest


def open_further(
    model: Model,
    generators: list[np.random.Generator],
    state: HandState,
    depth: Floats,
    redraw: NDArray[np.bool_],
    wanted: Requirements = NOTHING,
) -> NDArray[np.bool_]:
    """Redraw starts `redraw` (n,) deeper than `NO_PLACE` with hands further open; return their mask (n,).
    The pre-shape of some hands leaves no gap as wide as the object. `generators` continue from
    `clear_starts`. Better starts replace those in `state`, and their depths those in `depth`."""
    hand, obj = model.hand.model, model.obj.model
    lost = redraw & (depth > NO_PLACE)
    if not lost.any() or (wanted.like is None and JawStarts.of(hand, obj) is not None):
        return np.zeros(len(depth), bool)
    rows = np.flatnonzero(lost)
    probe = Probe(model, len(rows) * len(RETREATS))
    ends = np.where(hand.closing > 0, hand.lower, np.where(hand.closing < 0, hand.upper, hand.preshape))
    for share in OPENED:
        wider = replace(hand, preshape=hand.preshape + share * (ends - hand.preshape))
        pair = _Pair(wider, obj, OPENED_GAP, wanted)

        def drawn(rows: NDArray[np.intp], pair: _Pair = pair) -> HandState:
            return _retreats(*draw_starts(pair, [generators[i] for i in rows]))

        _draw_until_clear(drawn, probe, OPENED_DRAWS, rows[depth[rows] > CLEAR], state, depth)
    return lost


def _draw_until_clear(
    drawn: Callable[[NDArray[np.intp]], HandState],
    probe: Probe,
    draws: int,
    rows: NDArray[np.intp],
    best: HandState,
    deepest: Floats,
) -> None:
    """Draw starts of `rows` until they are clear; store the best in `best`, their depths in `deepest`.
    `drawn` returns hands for the given rows at each retreat distance."""
    for _ in range(draws):
        if not len(rows):
            return
        states = drawn(rows)
        depth = probe.depths(states).reshape(len(rows), -1)
        # Select the nearest clear distance, or else the least deep one.
        clear = depth <= CLEAR
        pick = np.where(clear.any(axis=1), clear.argmax(axis=1), depth.argmin(axis=1))
        found = states[np.arange(len(rows)) * depth.shape[1] + pick]
        depth = depth[np.arange(len(rows)), pick]
        better = depth < deepest[rows]
        store_states(best, rows[better], found[better])
        deepest[rows[better]] = depth[better]
        rows = rows[deepest[rows] > CLEAR]


def _draw_antipodal(
    reaching: ReachSampling,
    generators: list[np.random.Generator],
    rows: NDArray[np.intp],
    probe: Probe,
    best: HandState,
    deepest: Floats,
) -> None:
    """Store clear antipodal starts of `rows` in `best`, and their depths in `deepest`."""
    seeds = np.array([generators[i].integers(2**31) for i in rows], np.int32)
    first = np.zeros(len(rows), np.int32)
    left = np.arange(len(rows))
    for _ in range(LOOKS):
        found, number = reaching.starts(seeds[left], first[left], np.array(RETREATS))
        some = number >= 0
        left, found = left[some], found[some]
        if not len(left):
            return
        first[left] = number[some] + 1
        depth = probe.depths(found)
        clear = depth <= CLEAR
        store_states(best, rows[left[clear]], found[clear])
        deepest[rows[left[clear]]] = depth[clear]
        left = left[~clear]
        if not len(left):
            return


def store_states(states: HandState, rows: NDArray[np.intp], others: HandState) -> None:
    states.pivot[rows], states.rotation[rows], states.q[rows] = others.pivot, others.rotation, others.q


#: Clearance between each pad and the object [m]: least and most.
ROOM_M: Final = (0.002, 0.005)
#: Range of the pair's position ahead of the middle of the pads, and further retreats of hands that are not clear. Both
#: are shares of the pads' length.
AHEAD: Final = (-0.25, 0.25)

JAW_RETREATS: Final = (0.0, 0.25, 0.5, 0.75)
#: Shortest and longest pad length to which these shares refer [m].
LENGTH_M: Final = (0.01, 0.05)
#: Uniform numbers of one draw: pair, side, angle, clearance, place.
UNIFORM: Final = 5
#: Distance of a pair's line from the centre of mass at which its probability falls to exp(-1/2), as a share of the
#: object's radius.
CENTRAL: Final = 0.35


@dataclass(frozen=True)
class JawStarts:
    hand: HandModel
    obj: ObjectModel
    jaws: Jaws
    pairs: Pairs
    sums: Floats
    wanted: Requirements = NOTHING

    @classmethod
    def of(cls, hand: HandModel, obj: ObjectModel, wanted: Requirements = NOTHING) -> JawStarts | None:
        """Return the starts of a gripper, else None.
        Raises InputError: the object does not fit the jaws, or no pair is in the required region."""
        jaws, pairs = jaws_of(hand), fitting_pairs(hand, obj)
        if jaws is None or pairs is None:
            return None
        if not wanted.region.is_whole:
            inside = wanted.region.contains(pairs.start) & wanted.region.contains(pairs.end)
            if not inside.any():
                raise InputError(f"{obj.name} has no two opposite sides in the required region")
            pairs = Pairs(pairs.start[inside], pairs.end[inside])
        way = (pairs.end - pairs.start) / pairs.width[:, None]
        aside = np.linalg.norm(np.cross(pairs.start - obj.centre_of_mass, way), axis=1)
        weight = np.exp(-0.5 * (aside / (CENTRAL * obj.radius)) ** 2) + 1e-3
        return cls(hand, obj, jaws, pairs, np.cumsum(weight) / weight.sum(), wanted)

    def draw(self, uniform: Floats) -> HandState:
        """Return hands (n * len(JAW_RETREATS)) at each retreat, from random numbers (n, `UNIFORM`) in [0, 1)."""
        pick = np.minimum(np.searchsorted(self.sums, uniform[:, 0]), len(self.sums) - 1)
        start, end = self.pairs.start[pick], self.pairs.end[pick]
        swap = (uniform[:, 1] < 0.5)[:, None]
        start, end = np.where(swap, end, start), np.where(swap, start, end)
        room = ROOM_M[0] + (ROOM_M[1] - ROOM_M[0]) * uniform[:, 3]
        q, middle, axis = self.jaws.nearest_postures(np.minimum(self.pairs.width[pick] + 2 * room, self.jaws.opening))
        line = (end - start) / self.pairs.width[pick][:, None]
        helper = np.eye(3)[np.argmin(np.abs(line), axis=1)]
        x = np.cross(line, helper)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        angle = 2 * np.pi * uniform[:, 2][:, None]
        ahead = np.asarray(np.cos(angle) * x + np.sin(angle) * np.cross(line, x))
        if self.wanted.approach is not None:
            ahead = into_cone(ahead, self.wanted.approach, INNER * self.wanted.cone)
            ahead = ahead - np.einsum("ni,ni->n", ahead, line)[:, None] * line
            ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-6)
        own = _frames(axis, np.tile(self.hand.palm.approach, (len(q), 1)))
        rotation = quat_from_matrix(_frames(line, ahead) @ own.transpose(0, 2, 1))
        length = float(np.clip(self.jaws.length, *LENGTH_M))
        place = (AHEAD[0] + (AHEAD[1] - AHEAD[0]) * uniform[:, 4])[:, None] + np.array(JAW_RETREATS)[None]
        at = ((start + end) / 2)[:, None] - length * place[..., None] * ahead[:, None]
        pivot = at - self.obj.centre_of_mass + quat_rotate(rotation, self.hand.palm.centre - middle)[:, None]
        return hands_at_distances(pivot, rotation, q)


def _frames(x: Floats, z: Floats) -> Floats:
    """Return rotations (n, 3, 3) with first columns x (n, 3) and third columns nearest to z (n, 3)."""
    z = z - np.einsum("ni,ni->n", z, x)[:, None] * x
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)
