"""What goes to the device and comes back: the hands, and the values that each iteration takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from service.model.transforms import Floats


@dataclass
class HandState:
    """State of B hands: pivot (B, 3) = palm centre relative to the object's centre of mass, rotation (B, 4) w x y z,
    q (B, D)."""

    pivot: Floats
    rotation: Floats
    q: Floats

    def __getitem__(self, index: Any) -> HandState:
        return HandState(self.pivot[index], self.rotation[index], self.q[index])


@dataclass(frozen=True)
class Schedule:
    """Per-iteration values, arrays of length I; rates (I, 3) for translation [m], rotation [rad], joints."""

    dilation: Floats
    penetration: Floats
    object_penetration: Floats
    self_penetration: Floats
    rates: Floats

    def __len__(self) -> int:
        return len(self.dilation)


def still_schedule() -> Schedule:
    """Tables for telling distances and depths only: no dilation, no weights, no step."""
    zero = np.zeros(1)
    return Schedule(zero, zero, zero, zero, np.zeros((1, 3)))
