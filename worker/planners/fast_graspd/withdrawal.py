"""Whether a hand gets out of its grasp again: fingers opened plainly, it moves back the way it came.

A hand that hooks around an edge holds well and cannot be got there. Asked before the dear phases, of every hand.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import quat_rotate
from worker.planners.fast_graspd.starts import Probe
from worker.quality.contact import finger_of_body
from worker.simulation.model import Model
from worker.simulation.state import HandState

Floats = NDArray[np.float64]

#: Shares of their range by which fingers have opened, and how far the hand has moved back [m].
OUT: Final = ((0.2, 0.0), (0.3, 0.015), (0.4, 0.04))
#: Depth that is no hindrance [m]: a hand can open a little otherwise than plainly.
TOLERATED_M: Final = 0.001
#: Merit lost for each metre of depth: 5 mm outweigh a grasp that balances by a fifth of its forces.
WEIGHT: Final = 50.0
DEEPEST_M: Final = 0.01


def hindrance(model: Model, state: HandState, scenes: NDArray[np.integer]) -> Floats:
    """(n,) merit that hands lose since they cannot move straight back: what of them is then in the object or an
    obstacle of their scene (n,)."""
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
    deep = np.clip(depth - TOLERATED_M, 0.0, DEEPEST_M).reshape(len(OUT), n)
    return np.asarray(WEIGHT * deep.max(axis=0), float)
