"""Whether a hand gets out of its grasp again: fingers opened plainly, it moves back the way it came; closed, it rises.

A hand that hooks around an edge holds well and cannot be got there, and one close below a board cannot lift what it
holds. Asked before the dear phases, of every hand.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, quat_rotate
from graspd.worker.planners.fast_graspd.candidates import posture_of
from graspd.worker.planners.fast_graspd.starts import Probe
from graspd.worker.quality.contact import finger_of_body
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.environment import RISE_M, Environment, PlacedGrasps
from graspd.worker.simulation.model import Model
from graspd.worker.simulation.mounting import mounting_lack

#: Shares of their range by which fingers have opened, and how far the hand has moved back [m].
OUT: Final = ((0.2, 0.0), (0.3, 0.015), (0.4, 0.04))
#: Depth that is no hindrance [m]: a hand can open a little otherwise than plainly.
TOLERATED_M: Final = 0.001
#: Merit lost for each metre of depth: little, for hands that hold well reach around the object, and most of these get
#: out again in some way.
WEIGHT: Final = 25.0
DEEPEST_M: Final = 0.01
#: Shares of the lift at which what stands above is looked for.
UP: Final = (0.5, 1.0)


def hindrance(model: Model, state: HandState, placed: PlacedGrasps) -> Floats:
    """(n,) merit that hands lose since they cannot move straight back, or rise, in their scenes: what of them is then
    in the object or in an obstacle, or what of their mountings is in an obstacle already."""
    hand, obj = model.hand.model, model.obj.model
    mounted = mounting_lack(hand, posture_of(hand, obj, state).hand_pose, placed.scenes, placed.index)
    deep = np.maximum(_back(model, state, placed.index), mounted)
    rows = np.flatnonzero(np.array([not _open_above(scene) for scene in placed.scenes])[placed.index])
    if len(rows):
        deep[rows] = np.maximum(deep[rows], _rising(model, state[rows], placed.take(rows)))
    return np.asarray(WEIGHT * np.clip(deep - TOLERATED_M, 0.0, DEEPEST_M), float)


def _back(model: Model, state: HandState, scenes: NDArray[np.integer]) -> Floats:
    """(n,) depth of hands that open and move back [m]."""
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
    probe = Probe(model, len(OUT) * n)
    probe.data.set_scenes(np.tile(scenes, len(OUT)))
    probe.depths(states)
    found = probe.data.depths
    depth = np.max([kind.numpy()[: len(OUT) * n] for kind in (found.points, found.object, found.obstacles)], axis=0)
    return np.asarray(depth.reshape(len(OUT), n).max(axis=0), float)


def _open_above(scene: Environment) -> bool:
    """Whether nothing but floors, of which a hand that rises comes free, stands around."""
    return all(len(o.planes) == 1 and o.planes[0, :3] @ scene.up > 1 - 1e-6 for o in scene.obstacles)


def _rising(model: Model, state: HandState, placed: PlacedGrasps) -> Floats:
    """(n,) depth in obstacles of hands that rise as they are [m]."""
    n = len(state.pivot)
    up = np.array([scene.up for scene in placed.scenes])[placed.index]
    pivot = np.concatenate([state.pivot + share * RISE_M * up for share in UP])
    probe = Probe(model, len(UP) * n)
    probe.data.set_scenes(np.tile(placed.index, len(UP)))
    probe.depths(HandState(pivot, np.tile(state.rotation, (len(UP), 1)), np.tile(state.q, (len(UP), 1))))
    return np.asarray(probe.data.depths.obstacles.numpy()[: len(UP) * n].reshape(len(UP), n).max(axis=0), float)
