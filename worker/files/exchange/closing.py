"""Fingers for grasps of which a source tells only where the hand is."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import apply
from worker.grasps import Posture
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.autograsp import kernels
from worker.planners.autograsp.closing import Closer
from worker.planners.fast_graspd.selection import posture_of
from worker.planners.peers import ground_of
from worker.simulation.state import HandState

#: Hands that are closed at once.
_AT_ONCE: Final = 256


def closed_at(hand: HandModel, obj: ObjectModel, hand_pose: NDArray[np.float64]) -> Posture:
    """The hand at poses (N, 7) in the object frame, its fingers closed from its preshape until they touch or end."""
    pair = ground_of(hand, obj, "cpu", kernels)
    joints = np.zeros((len(hand_pose), len(hand.joint_names)))
    for first in range(0, len(hand_pose), _AT_ONCE):
        pose = hand_pose[first : first + _AT_ONCE]
        palm = apply(pose, hand.palm.centre) - obj.centre_of_mass
        state = HandState(palm, pose[:, 3:], np.tile(hand.preshape, (len(pose), 1)))
        closed = Closer(pair, len(pose)).close(state).state
        joints[first : first + len(pose)] = posture_of(hand, obj, closed).joint_positions
    return Posture(hand_pose, joints)
