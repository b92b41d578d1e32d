"""Test whether a hand can leave its grasp: open, back along the approach, and closed, by the lift.

A hand hooked around an edge holds well but cannot get there; one close below a board cannot lift. The test runs for
every hand before the expensive phases.
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

#: Shares of their range by which fingers have opened, and the distance that the hand has moved back [m].
OUT: Final = ((0.2, 0.0), (0.3, 0.015), (0.4, 0.04))
#: Tolerated depth [m]: a hand can open differently from this simple motion.
TOLERATED_M: Final = 0.001
#: Merit lost per metre of depth. The weight is small: hands that hold well enclose the object, and most of them find
#: another trajectory out.
WEIGHT: Final = 25.0
DEEPEST_M: Final = 0.01
#: Shares of the lift at which obstacles above are checked.
UP: Final = (0.5, 1.0)


def hindrance(model: Model, state: HandState, placed: PlacedGrasps) -> Floats:
    """Compute the merit (n,) that hands lose for a blocked retreat or lift in their scenes.
    It grows with the depth of the hand in object or obstacles on the way, or of its mounting at the grasp."""
    hand, obj = model.hand.model, model.obj.model
    mounted = mounting_lack(hand, posture_of(hand, obj, state).hand_pose, placed.scenes, placed.index)
    deep = np.maximum(_back(model, state, placed.index), mounted)
    rows = np.flatnonzero(np.array([not _open_above(scene) for scene in placed.scenes])[placed.index])
    if len(rows):
        deep[rows] = np.maximum(deep[rows], _rising(model, state[rows], placed.take(rows)))
    return np.asarray(WEIGHT * np.clip(deep - TOLERATED_M, 0.0, DEEPEST_M), float)


def _back(model: Model, state: HandState, scenes: NDArray[np.integer]) -> Floats:
    """Return the depth (n,) of hands that open and move back [m]."""
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
    """Check whether all obstacles are floors, which a rising hand always leaves."""
    return all(len(o.planes) == 1 and o.planes[0, :3] @ scene.up > 1 - 1e-6 for o in scene.obstacles)


def _rising(model: Model, state: HandState, placed: PlacedGrasps) -> Floats:
    """Return the depth (n,) in obstacles of hands that rise in their grasp posture [m]."""
    n = len(state.pivot)
    up = np.array([scene.up for scene in placed.scenes])[placed.index]
    pivot = np.concatenate([state.pivot + share * RISE_M * up for share in UP])
    probe = Probe(model, len(UP) * n)
    probe.data.set_scenes(np.tile(placed.index, len(UP)))
    probe.depths(HandState(pivot, np.tile(state.rotation, (len(UP), 1)), np.tile(state.q, (len(UP), 1))))
    return np.asarray(probe.data.depths.obstacles.numpy()[: len(UP) * n].reshape(len(UP), n).max(axis=0), float)
