"""Timed motions: the targets of a robot that executes one grasp, from its home posture to the lifted object."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats

#: Time between targets [s].
CONTROL_STEP_S: Final = 0.02


@dataclass(frozen=True)
class Motion:
    """K targets of a robot at equal times; the first is its home posture at rest."""

    phase: NDArray[np.uint8]  # (K,) indices of `PHASES`
    time: Floats  # (K,) times since the start [s]
    targets: Floats  # (K, D) in the order of `Robot.names` [m, 1, rad]
