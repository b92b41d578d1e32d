"""Approach sampling: where the hands start. The palm looks at a random point of the surface, from a little way off;
jaws of a gripper stand around two opposite places (`jaw_starts`).

A start is taken only if nothing touches: hands that start inside a thin wall never leave it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.errors import InputError
from service.model.transforms import cross, quat_from_axis_angle, quat_from_matrix, quat_multiply
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.fast_graspd import jaw_starts
from worker.planners.fast_graspd.jaw_starts import JawStarts
from worker.simulation.data import Data
from worker.simulation.model import Model
from worker.simulation.record import record_placement
from worker.simulation.state import HandState

Floats = NDArray[np.float64]

#: Distance of the palm from the surface [m]: nearest, farthest, then the steps of retreat while something touches.
GAP: Final = (0.004, 0.02)
RETREATS: Final = (0.0, 0.01, 0.02, 0.03)
#: Tilt of the approach away from the surface normal, standard deviation [rad].
TILT: Final = 0.25
#: Noise of the pre-shape, standard deviation as a share of the joint's range.
POSTURE_NOISE: Final = 0.08
#: Deepest penetration of a start [m].
CLEAR: Final = 0.001
#: Draws per grasp before the least penetrating one is taken.
DRAWS: Final = 48


@dataclass
class _Draw:
    state: HandState
    approach: Floats


def start_generator(seed: int, batch: int, index: int, start: int) -> np.random.Generator:
    """Random numbers of one start of one grasp, independent of every other."""
    return np.random.default_rng(np.random.SeedSequence([seed, batch, index, start]))


def _frame(z: Floats) -> Floats:
    """Rotation matrix with third column z (3,) and an arbitrary but fixed first."""
    helper = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = cross(helper, z)
    x /= np.linalg.norm(x)
    return np.stack([x, cross(z, x), z], axis=1)


@dataclass(frozen=True)
class _Pair:
    """What all draws of a hand around an object share."""

    hand: HandModel
    centre: Floats
    """(3,) centre of mass of the object [m]."""
    corners: Floats
    """(F, 3, 3) corners of its faces [m]."""
    across: Floats
    """(F, 3) normals of twice the faces' area [m^2]."""
    area: Floats
    """(F,) [m^2], doubled."""
    share: Floats
    """(F,) the area of the faces up to each, over the whole."""
    palm: Floats
    """(3, 3) rotation to the frame of the palm's approach."""

    @classmethod
    def of(cls, hand: HandModel, obj: ObjectModel) -> _Pair:
        corners = obj.vertices[obj.faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(across, axis=1)
        share = np.cumsum(area / area.sum())
        return cls(hand, obj.centre_of_mass, corners, across, area, share / share[-1], _frame(hand.palm.approach).T)


def draw(pair: _Pair, rng: np.random.Generator) -> _Draw:
    """One candidate start at its nearest distance; `approach` (3,) is the direction in which the palm looks."""
    hand = pair.hand
    face = int(pair.share.searchsorted(rng.random(), side="right"))
    u, v = rng.random(2)
    if u + v > 1:
        u, v = 1 - u, 1 - v
    corner = pair.corners[face]
    point = corner[0] + u * (corner[1] - corner[0]) + v * (corner[2] - corner[0])
    normal = pair.across[face] / pair.area[face]
    tilt_axis = _frame(normal)[:, :2] @ rng.normal(size=2)
    angle = float(np.linalg.norm(tilt_axis)) * TILT
    if angle > 1e-9:
        axis = tilt_axis / np.linalg.norm(tilt_axis)
        normal = normal * np.cos(angle) + cross(axis, normal) * np.sin(angle)
    approach = -normal
    align = _frame(approach) @ pair.palm
    roll = quat_from_axis_angle(approach, np.array(rng.uniform(0, 2 * np.pi)))
    rotation = quat_multiply(roll, quat_from_matrix(align))
    span = hand.upper - hand.lower
    q = np.clip(hand.preshape + POSTURE_NOISE * span * rng.normal(size=hand.dofs), hand.lower, hand.upper)
    pivot = point - pair.centre - approach * rng.uniform(*GAP)
    return _Draw(HandState(pivot[None], rotation[None], q[None]), approach)


def _retreated(draws: list[_Draw]) -> HandState:
    """Each draw at each distance of retreat, (len(draws) * len(RETREATS)) hands."""
    back = np.array(RETREATS)[None, :, None]
    pivot = np.stack([d.state.pivot[0] for d in draws])[:, None] - back * np.stack([d.approach for d in draws])[:, None]
    repeat = len(RETREATS)
    return HandState(
        pivot.reshape(-1, 3),
        np.repeat(np.stack([d.state.rotation[0] for d in draws]), repeat, axis=0),
        np.repeat(np.stack([d.state.q[0] for d in draws]), repeat, axis=0),
    )


class Probe:
    """Places hands and tells how deep they are, and how near the object; `room` as `record_placement` has it."""

    def __init__(self, model: Model, capacity: int, *, room: float = 0.0) -> None:
        self.data = Data(model, capacity)
        self.band = model.options.band
        self._placement = record_placement(model, self.data, room=room)

    def depths(self, states: HandState) -> Floats:
        """Deepest penetration of each hand (n,) [m]: into the object, of the object into links, of links into links,
        and what it lacks of its distance from obstacles."""
        self.data.set_state(states)
        self._placement.run()
        return self.data.deepest(len(states.pivot)).astype(float)

    def nearest(self, states: HandState) -> Floats:
        """Distance of each hand's nearest point from the object (n,) [m], at most the model's band."""
        self.depths(states)
        n = len(states.pivot)
        counts = self.data.contacts.count.numpy()[:n]
        distances = self.data.contacts.distance.numpy()[:n]
        present = np.arange(distances.shape[1]) < counts[:, None]
        return np.where(present, distances, self.band).min(axis=1).clip(0.0, self.band).astype(float)


def sample_starts(model: Model, *, seed: int, batch: int, indices: range, each: int) -> HandState:
    """Collision-free starts of the grasps `indices` of a batch, `each` per grasp, those of one grasp side by side.

    Raises:
        InputError: not one draw of some grasp came within 10 mm of being clear.
    """
    hand, obj = model.hand.model, model.obj.model
    jaws = JawStarts.of(hand, obj)
    retreats = RETREATS if jaws is None else jaw_starts.RETREATS
    probe = Probe(model, len(indices) * each * len(retreats))
    pair = _Pair.of(hand, obj)
    generators = [start_generator(seed, batch, i, k) for i in indices for k in range(each)]
    best: list[tuple[float, HandState] | None] = [None] * len(generators)
    open_ = list(range(len(generators)))
    for _ in range(DRAWS):
        if jaws is None:
            states = _retreated([draw(pair, generators[i]) for i in open_])
        else:
            states = jaws.draw(np.array([generators[i].random(jaw_starts.UNIFORM) for i in open_]))
        depth = probe.depths(states).reshape(len(open_), len(retreats))
        for row, i in enumerate(open_):
            # The nearest clear distance, or else the least deep.
            clear = np.flatnonzero(depth[row] <= CLEAR)
            pick = int(clear[0]) if len(clear) else int(np.argmin(depth[row]))
            found = best[i]
            if found is None or depth[row, pick] < found[0]:
                k = row * len(retreats) + pick
                best[i] = (float(depth[row, pick]), states[k : k + 1])
        open_ = [i for i in open_ if (b := best[i]) is None or b[0] > CLEAR]
        if not open_:
            break
    chosen = [b for b in best if b is not None]
    if max(b[0] for b in chosen) > 0.01:
        raise InputError(
            f"{hand.name} finds no free place around {obj.name}: the object is too large or encloses the hand; "
            "check the object's units"
        )
    return HandState(
        np.concatenate([b[1].pivot for b in chosen]),
        np.concatenate([b[1].rotation for b in chosen]),
        np.concatenate([b[1].q for b in chosen]),
    )
