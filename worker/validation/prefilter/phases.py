"""What the prefilter found out about grasps, and which of its verdicts are clear. The rest is for the CPU."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats
from graspd.worker.validation.protocol import Outcome

#: A verdict is clear where the worst motion that was seen is below the first share of its limit, or above the second.
#: Both engines' margins of a grasp that holds differ by 0.11 at the 99th percentile (benchmarks.prefilter).
BAND: Final = (0.8, 1.2)
#: Ticks of a push that breaks a limit until it is clear; what is still in the band then is not.
PATIENCE: Final = 5
#: Ticks (of `protocol.INTERVAL_S`) after which a grasp stays undecided: a grasp that holds takes 32 at least, 1 of 100
#: more than 47. Few creepers would keep a launch waiting.
MOST_TICKS: Final = 48
#: One clear verdict in so many is asked of the CPU as well.
RECHECK_ONE_IN: Final = 50
#: Raise when the code changes what the prefilter says, constants aside.
REVISION: Final = 1


@dataclass(frozen=True)
class PrefilterOutcomes:
    """What the worlds say of N grasps."""

    outcome: NDArray[np.uint8]
    """(N, 6) `Outcome` of each push; a grasp that stays undecided has pushes that were not tried."""
    margin: Floats
    """(N,) worst displacement or rotation over its limit that was seen."""
    penetration_m: Floats
    """(N,) of hand and object in the grasp."""
    self_penetration_m: Floats
    """(N,)"""
    overflow: NDArray[np.bool_]
    """(N,) whether contacts or constraints were left out for want of room."""
    ticks: NDArray[np.int32]
    """(N,) simulated, of `protocol.INTERVAL_S` each."""

    @property
    def held(self) -> NDArray[np.bool_]:
        """(N,) whether all six pushes were held, clearly or not."""
        return np.asarray((self.outcome == Outcome.HELD).all(axis=1))

    @property
    def clearly_held(self) -> NDArray[np.bool_]:
        """(N,) with room to spare."""
        return np.asarray(self.held & (self.margin < BAND[0]) & ~self.overflow)

    @property
    def clearly_failed(self) -> NDArray[np.bool_]:
        """(N,) the object is lost, or the hand starts inside it."""
        inside = self.outcome[:, 0] == Outcome.PENETRATION
        kinds = (Outcome.LOST_WHILE_CLOSING, Outcome.DISPLACED, Outcome.ROTATED)
        lost = np.isin(self.outcome, kinds).any(axis=1) & np.isfinite(self.margin) & (self.margin > BAND[1])
        return np.asarray((inside | lost) & ~self.overflow)

    @staticmethod
    def terms(engine: str) -> list[Any]:
        """What verdicts of a version of the engine follow from, beside the standard level's own terms."""
        return [engine, REVISION, *BAND, PATIENCE, MOST_TICKS, RECHECK_ONE_IN]

    def put(self, rows: NDArray[np.intp], again: Self) -> Self:
        """The same with some rows replaced by those of other trials."""
        changed: dict[str, Any] = {}
        for field in fields(self):
            changed[field.name] = getattr(self, field.name).copy()
            changed[field.name][rows] = getattr(again, field.name)
        return replace(self, **changed)
