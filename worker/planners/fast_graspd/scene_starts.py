"""Starts in scenes, sampled along free approach directions for all hands at once.
Most starts are antipodal; in the others the palm faces a random point of the object, as in `starts`.
A start has `ROOM` more clearance from obstacles than required later, so that the optimisation can rotate the hand.

Before the fine phase `obstruction` tests whether each hand can leave its grasp, both open along the approach and closed
on the lift. A hand hooked around an edge holds well but cannot reach its grasp. A hand close below a board
cannot lift."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import (
    Floats,
    Mask,
    quat_from_axis_angle,
    quat_from_matrix,
    quat_multiply,
    quat_rotate,
    spread_directions,
)
from graspd.worker.hands.digits import finger_of_body
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.mesh_geometry import points_on_triangles
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd import starts
from graspd.worker.planners.fast_graspd.antipodal_starts import (
    NEAR_M,
    AntipodalHands,
    Openings,
    place_antipodal_hands,
    select_draws,
)
from graspd.worker.planners.fast_graspd.candidates import posture_of
from graspd.worker.planners.fitting import region_points, surface_of
from graspd.worker.planners.port import NoStartFound
from graspd.worker.planners.requirements import LIKE_M, NOTHING, Requirements
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.environment import RISE_M, STANDOFF_M, Environment, PlacedGrasps
from graspd.worker.simulation.model import Model
from graspd.worker.simulation.mounting import missing_mounting_clearance

Ints = NDArray[np.intp]

#: Clearance of a start from obstacles in addition to the margin [m].
ROOM: Final = 0.006
#: Nearest and farthest distance of a palm from the random point in front of it [m].
GAP: Final = (0.004, 0.02)
#: Retreats at which a draw is tested [m]. They are longer than for a free object, so that fingers clear the table.
RETREATS: Final = (0.0, 0.01, 0.02, 0.035, 0.055, 0.08, 0.11)
#: Draws per start before the least penetrating one is selected.
DRAWS: Final = 96
#: Number of draws whose normal random numbers are generated together.
DRAWN: Final = 8
#: Half the width of a palm [m], number of directions, and least cosine of an approach with the nearest free one.
PALM_RADIUS: Final = 0.04
DIRECTIONS: Final = 256
NEAR_WAY: Final = 0.98
#: `REACHING` of `EVERY` starts of a grasp are antipodal. Each comes from the best `REACHES` of `CANDIDATES` draws.
EVERY: Final = 8
REACHING: Final = 7
REACHES: Final = 8
CANDIDATES: Final = 48
#: Uniform numbers of one draw: face, two for the point, roll, gap, share and goal of a rotation.
_UNIFORM: Final = 7


#: Indices among the draws, and the antipodal hands at these indices.
_AcrossPairs = list[tuple[Ints, AntipodalHands]]


def free_directions(scene: Environment, obj: ObjectModel) -> Floats:
    """Return free approach directions (K, 3), unit vectors in the object frame.
    Along a free direction, a ball of half a palm's width can move from the object by `STANDOFF_M` without contact with
    an obstacle. Raises InputError: there is no free direction."""
    ways = spread_directions(DIRECTIONS)
    out = ((obj.hull_vertices - obj.centre_of_mass) @ ways.T).max(axis=0)
    path = out[:, None] + PALM_RADIUS + np.linspace(0.0, STANDOFF_M, 9)
    points = obj.centre_of_mass + path[..., None] * ways[:, None]
    free = np.ones(DIRECTIONS, bool)
    for obstacle in scene.obstacles:
        free &= obstacle.distance(points).min(axis=1) > 0.5 * PALM_RADIUS
    if not free.any():
        raise InputError(f"nothing can reach {obj.name} in this scene: obstacles stand on every side of it")
    return np.asarray(ways[free])


def no_room_error(hand: HandModel, scenes: int) -> NoStartFound:
    return NoStartFound(
        f"the table or another obstacle blocks the palm of {hand.name} at the demonstrated wrist pose in each of "
        f"{scenes} scenes: choose another pose or resting face (--faces all)"
    )


def no_start_error(model: Model, wanted: Requirements = NOTHING) -> NoStartFound:
    hand, obj = model.hand.model, model.obj.model
    if wanted.like is not None:
        return NoStartFound(
            f"{hand.name} finds no free place at the demonstrated wrist pose: {obj.name} or obstacles of its scenes "
            "are in the way"
        )
    return NoStartFound(
        f"{hand.name} finds no free place around {obj.name} in this scene: the object is too large, or its "
        "surroundings leave no room"
    )


def clear_scene_starts(
    model: Model,
    generators: list[np.random.Generator],
    *,
    each: int,
    placed: PlacedGrasps,
    ways: Sequence[Floats],
    wanted: Requirements = NOTHING,
) -> tuple[HandState, Floats]:
    """Return a start for each generator, `each` per grasp, and its depth (n,) [m].
    The start is the first clear draw, or the least deep one; an antipodal start is the clear draw with its pair nearest
    to the pads. In a narrow scene some grasps find no clear start; the batch still contains them, as blocked grasps.
    `ways` are the `free_directions` of each scene."""
    hand, obj = model.hand.model, model.obj.model
    probe = starts.Probe(model, len(generators), room=ROOM)
    used = set(placed.index.tolist())
    openings = {s: Openings.in_scene(hand, obj, scene, wanted) for s, scene in enumerate(placed.scenes) if s in used}
    scene, at_pose = np.repeat(placed.index, each), wanted.like is not None
    reaching = (np.arange(len(scene)) % each % EVERY < REACHING) | wanted.by_pads
    reaching &= np.array([not at_pose and len(openings[s].sums) > 0 for s in scene.tolist()], bool)
    count, around = len(scene), _SceneDraws(hand, obj, ways, openings, wanted)
    uniform = np.array([g.random((DRAWS, _UNIFORM)) for g in generators])
    normal = np.zeros((count, 0, (6 if at_pose else 2) + hand.dofs))
    best = HandState(np.zeros((count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)), np.zeros((count, hand.dofs)))
    depth, beside = np.full(count, np.inf), np.where(reaching, np.inf, 0.0)
    order, least_beside = around.select_draws(uniform, scene, reaching, placed)
    for number in range(DRAWS):
        redraw = depth > starts.CLEAR
        if number < REACHES:
            redraw |= reaching & (beside > NEAR_M) & (least_beside[:, number] < beside)
        rows = np.flatnonzero(redraw)
        if not len(rows):
            break
        if number == normal.shape[1]:
            # Most starts need few draws, so random numbers of later draws are generated on demand.
            normal = np.concatenate([normal, _normal(generators, rows, normal.shape[2])], axis=1)
        reach = reaching[rows] & (number < REACHES)
        numbers = np.where(reach, order[rows, min(number, REACHES - 1)], number)
        states, across_pairs = around.hands_of_draws(uniform[rows, numbers], normal[rows, number], scene[rows], reach)
        off = _raise_draws(states, across_pairs, np.flatnonzero(reach), placed, scene[rows], probe)
        worth = off < beside[rows, None]
        worth[~reach | (depth[rows] > starts.CLEAR)] = True
        worth &= not at_pose or np.array(RETREATS) <= LIKE_M
        found = _depths(probe, states, placed, scene[rows], worth)
        # Select the nearest clear distance, or else the least deep one.
        clear = found <= starts.CLEAR
        pick = np.where(clear.any(axis=1), clear.argmax(axis=1), found.argmin(axis=1))
        at = np.arange(len(rows)), pick
        least = found[at]
        better = np.where(
            least <= starts.CLEAR, (depth[rows] > starts.CLEAR) | (off[at] < beside[rows]), least < depth[rows]
        )
        taken = states[(at[0] * len(RETREATS) + pick)[better]]
        depth[rows[better]] = least[better]
        beside[rows[better]] = np.where(least <= starts.CLEAR, off[at], beside[rows])[better]
        starts.store_states(best, rows[better], taken)
    return best, depth


def _normal(generators: list[np.random.Generator], rows: Ints, numbers: int) -> Floats:
    out = np.zeros((len(generators), DRAWN, numbers))
    for row in rows.tolist():
        out[row] = generators[row].standard_normal((DRAWN, numbers))
    return out


def _depths(probe: starts.Probe, states: HandState, placed: PlacedGrasps, scene: Ints, worth: Mask) -> Floats:
    """Return depths (n, len(RETREATS)) [m] of hands and mountings in scenes (n,); inf if not computed.
    Only retreats with `worth` (n, len(RETREATS)) are computed, from the farthest inwards, until one is not clear.
    Most draws fail for reasons that no retreat fixes. A draw that is not clear at one distance is hardly ever clear at
    a smaller one."""
    found, open_ = np.full((len(scene), len(RETREATS)), np.inf), np.ones(len(scene), bool)
    for k in reversed(range(len(RETREATS))):
        left = np.flatnonzero(open_ & worth[:, k])
        if len(left):
            probe.data.set_scenes(scene[left])
            some = states[left * len(RETREATS) + k]
            found[left, k] = probe.depths(some)
            clear = np.flatnonzero(found[left, k] <= starts.CLEAR)
            lack = _missing_mounting_clearance(probe, some[clear], placed, scene[left[clear]], exact=True)
            found[left[clear], k] = np.maximum(found[left[clear], k], lack)
            open_[left] = found[left, k] <= starts.CLEAR
    return found


def _missing_mounting_clearance(
    probe: starts.Probe, states: HandState, placed: PlacedGrasps, scene: Ints, *, exact: bool
) -> Floats:
    """Return by how much (n,) mountings in scenes (n,) miss the margin plus `ROOM` [m]; at least 0."""
    hand, obj = probe.model.hand.model, probe.model.obj.model
    poses = posture_of(hand, obj, states).hand_pose
    return missing_mounting_clearance(hand, poses, placed.scenes, scene, room=ROOM, exact=exact)


def _raise_draws(
    states: HandState, across_pairs: _AcrossPairs, rows: Ints, placed: PlacedGrasps, scene: Ints, probe: starts.Probe
) -> Floats:
    """Raise draws `rows` in scenes (n,), at all retreats, by the clearance missing at the nearest retreat.
    Return the distance (n, len(RETREATS)) of their pairs from the middle of the pads [m], 0 for other draws. Retreat
    steps alone are too coarse for low objects: fingers would end above the object, not beside it."""
    off = np.zeros((len(scene), len(RETREATS)))
    if not len(rows):
        return off
    repeat, up = len(RETREATS), np.array([s.up for s in placed.scenes])[scene]
    probe.data.set_scenes(scene[rows])
    probe.depths(states[rows * repeat])
    lifted = np.zeros((len(scene), 3))
    lack = probe.data.depths.obstacles.numpy()[: len(rows)].astype(float)
    lack = np.maximum(lack, _missing_mounting_clearance(probe, states[rows * repeat], placed, scene[rows], exact=False))
    lifted[rows] = lack[:, None] * up[rows]
    every = (rows[:, None] * repeat + np.arange(repeat)).ravel()
    states.pivot[every] += np.repeat(lifted[rows], repeat, axis=0)
    for at, reaches in across_pairs:
        off[at] = reaches.pad_distance(lifted[at][:, None] + np.array(RETREATS)[:, None] * reaches.away[:, None])
    return off


@dataclass(frozen=True)
class _SceneDraws:
    hand: HandModel
    obj: ObjectModel
    ways: Sequence[Floats]
    openings: Mapping[int, Openings]
    wanted: Requirements = NOTHING

    def select_draws(self, uniform: Floats, scene: Ints, reaching: Mask, placed: PlacedGrasps) -> tuple[Ints, Floats]:
        """Return draws and distances (n, REACHES) of `select_draws`; 0 and inf unless `reaching`."""
        order, least = np.zeros((len(scene), REACHES), np.intp), np.full((len(scene), REACHES), np.inf)
        for s in np.unique(scene[reaching]):
            rows = np.flatnonzero(reaching & (scene == s))
            opening, ways, drawn = self.openings[s], self.ways[s], uniform[rows, :CANDIDATES, :6]
            order[rows], least[rows] = select_draws(
                self.hand, self.obj, opening, drawn, ways, placed.scenes[s], room=ROOM, keep=REACHES
            )
        return order, least

    def hands_of_draws(
        self, uniform: Floats, normal: Floats, scene: Ints, reach: Mask
    ) -> tuple[HandState, _AcrossPairs]:
        """Return hands (n * len(RETREATS)) drawn in scenes (n,) at all retreats, and the antipodal hands.
        `reach` (n,): whether a hand is antipodal. Random numbers: uniform (n, 7), normal (n, 2 + D or 6 + D)."""
        n, dofs = len(uniform), self.hand.dofs
        pivot, rotation, q, away = np.zeros((n, 3)), np.zeros((n, 4)), np.zeros((n, dofs)), np.zeros((n, 3))
        reaching = []
        for s in np.unique(scene):
            rows = np.flatnonzero((scene == s) & reach)
            if len(rows):
                one = place_antipodal_hands(self.hand, self.obj, self.openings[s], uniform[rows, :6], self.ways[s])
                pivot[rows], rotation[rows], away[rows] = one.pivot, quat_from_matrix(one.turn), one.away
                q[rows] = one.q(self.hand, normal[rows, 2:])
                reaching.append((rows, one))
            rows = np.flatnonzero((scene == s) & ~reach)
            if len(rows):
                pivot[rows], rotation[rows], q[rows], away[rows] = self._towards(
                    uniform[rows], normal[rows], self.ways[s]
                )
        pivot = pivot[:, None] + np.array(RETREATS)[None, :, None] * away[:, None]
        return starts.hands_at_distances(pivot, rotation, q), reaching

    def _towards(self, uniform: Floats, normal: Floats, ways: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Place palms towards random surface points, or at the demonstrated wrist pose.
        Return pivots, rotations, dofs, directions of retreat."""
        hand, obj = self.hand, self.obj
        if self.wanted.like is not None:
            state, approach = starts.draw_at_pose(hand, obj.centre_of_mass, self.wanted.like, normal)
            return state.pivot, state.rotation, state.q, -approach
        corners, normals, sums = surface_of(obj)
        face = np.minimum(np.searchsorted(sums, uniform[:, 0]), len(sums) - 1)
        point = points_on_triangles(corners[face], uniform[:, 1:2], uniform[:, 2:3])
        if not self.wanted.region.is_whole:
            places, faces = region_points(obj, self.wanted.region)
            chosen = (uniform[:, 0] * len(places)).astype(int)
            point, face = places[chosen], faces[chosen]
        away = _tilted(normals[face], starts.TILT * normal[:, :2])
        away = np.array([_turned(a, ways, t) for a, t in zip(away, uniform[:, 5:7], strict=True)])
        align = starts.frames_about(-away) @ starts.frames_about(hand.palm.approach).T
        roll = quat_from_axis_angle(-away, 2 * np.pi * uniform[:, 3])
        rotation = quat_multiply(roll, quat_from_matrix(align))
        q = np.clip(hand.preshape + starts.POSTURE_NOISE * hand.span * normal[:, 2:], hand.lower, hand.upper)
        gap = GAP[0] + (GAP[1] - GAP[0]) * uniform[:, 4:5]
        return point - obj.centre_of_mass + gap * away, rotation, q, away


def _turned(away: Floats, ways: Floats, random: Floats) -> Floats:
    """Return `away` (3,), rotated towards a random free direction until it is near any free direction."""
    if (ways @ away).max() >= NEAR_WAY:
        return away
    goal = ways[int(random[1] * len(ways))]
    for share in np.linspace(0.2 + 0.8 * random[0], 1.0, 4):
        mixed = (1 - share) * away + share * goal
        length = float(np.linalg.norm(mixed))
        if length > 1e-6 and (ways @ mixed).max() >= NEAR_WAY * length:
            return np.asarray(mixed / length)
    return goal


def _tilted(normals: Floats, angles: Floats) -> Floats:
    """Return unit vectors (n, 3): normals turned about two perpendicular axes by `angles` (n, 2) [rad]."""
    axis = np.einsum("nij,nj->ni", starts.frames_about(normals)[..., :2], angles)
    angle = np.linalg.norm(axis, axis=1, keepdims=True)
    unit = axis / np.maximum(angle, 1e-12)
    return np.asarray(normals * np.cos(angle) + np.cross(unit, normals) * np.sin(angle))


#: Opening of the fingers as shares of their range, and the distance of the hand's retreat [m].
OUT: Final = ((0.2, 0.0), (0.3, 0.015), (0.4, 0.04))
#: Tolerated depth [m]: the real opening of a hand can differ from this simple motion.
TOLERATED_M: Final = 0.001
#: Penalty on the merit per metre of depth [1/m]. The weight is small: hands that hold well enclose the object, and most
#: of them can leave it along another trajectory.
WEIGHT: Final = 25.0
DEEPEST_M: Final = 0.01
#: Shares of the lift at which obstacles above are checked.
UP: Final = (0.5, 1.0)


def obstruction(model: Model, state: HandState, placed: PlacedGrasps) -> Floats:
    """Compute the penalty (n,) on the merits of hands whose retreat or lift is blocked in their scenes.
    The penalty grows with the depth of the hand in object or obstacles on the trajectory, and with the clearance that
    its mounting misses at the grasp."""
    hand, obj = model.hand.model, model.obj.model
    mounted = missing_mounting_clearance(hand, posture_of(hand, obj, state).hand_pose, placed.scenes, placed.index)
    deep = np.maximum(_retreat_obstruction(model, state, placed.index), mounted)
    rows = np.flatnonzero(np.array([not _is_open_above(scene) for scene in placed.scenes])[placed.index])
    if len(rows):
        deep[rows] = np.maximum(deep[rows], _lift_obstruction(model, state[rows], placed.take(rows)))
    return np.asarray(WEIGHT * np.clip(deep - TOLERATED_M, 0.0, DEEPEST_M), float)


def _retreat_obstruction(model: Model, state: HandState, scenes: NDArray[np.integer]) -> Floats:
    hand = model.hand.model
    finger = finger_of_body(hand)
    driven = np.zeros(hand.dofs, bool)
    driven[hand.dof[finger >= 0]] = True
    back = -quat_rotate(state.rotation, hand.palm.approach)
    n = len(state.pivot)
    opened = [np.where(driven, state.q - share * hand.span * hand.closing, state.q) for share, _ in OUT]
    states = HandState(
        np.concatenate([state.pivot + far * back for _, far in OUT]),
        np.tile(state.rotation, (len(OUT), 1)),
        np.clip(np.concatenate(opened), hand.lower, hand.upper),
    )
    probe = starts.Probe(model, len(OUT) * n)
    probe.data.set_scenes(np.tile(scenes, len(OUT)))
    probe.depths(states)
    found = probe.data.depths
    depth = np.max([kind.numpy()[: len(OUT) * n] for kind in (found.points, found.object, found.obstacles)], axis=0)
    return np.asarray(depth.reshape(len(OUT), n).max(axis=0), float)


def _is_open_above(scene: Environment) -> bool:
    return all(len(o.planes) == 1 and o.planes[0, :3] @ scene.up > 1 - 1e-6 for o in scene.obstacles)


def _lift_obstruction(model: Model, state: HandState, placed: PlacedGrasps) -> Floats:
    n = len(state.pivot)
    up = np.array([scene.up for scene in placed.scenes])[placed.index]
    pivot = np.concatenate([state.pivot + share * RISE_M * up for share in UP])
    probe = starts.Probe(model, len(UP) * n)
    probe.data.set_scenes(np.tile(placed.index, len(UP)))
    probe.depths(HandState(pivot, np.tile(state.rotation, (len(UP), 1)), np.tile(state.q, (len(UP), 1))))
    return np.asarray(probe.data.depths.obstacles.numpy()[: len(UP) * n].reshape(len(UP), n).max(axis=0), float)
