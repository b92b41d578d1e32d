"""Results of the prefilter, and which of its verdicts are clear. The CPU validates the rest."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats
from graspd.worker.validation.protocol import Outcome

#: A verdict is clear if the worst motion is below the first share of its limit, or above the second. The margins of a
#: grasp that holds differ between both engines by 0.11 at the 99th percentile (benchmarks.prefilter).
BAND: Final = (0.8, 1.2)
#: Ticks of a push after it breaks a limit; if still in the band then, the verdict is not clear.
PATIENCE: Final = 5
#: Ticks (of `protocol.INTERVAL_S`) after which a grasp stays undecided. A grasp that holds takes 32 at least, 1 of 100
#: more than 47; a few slow creepers would delay the whole launch.
MOST_TICKS: Final = 48
#: One clear verdict in so many is validated on the CPU as well.
RECHECK_ONE_IN: Final = 50
#: Increase when the code changes the prefilter's verdicts, constants aside.
REVISION: Final = 1


@dataclass(frozen=True)
class PrefilterOutcomes:
    """Outcomes of N grasps in the worlds."""

    outcome: NDArray[np.uint8]
    """(N, 6) `Outcome` of each push; an undecided grasp has pushes that were not simulated."""
    margin: Floats
    """(N,) worst displacement or rotation over its limit."""
    penetration_m: Floats
    """(N,) penetration of hand and object in the grasp."""
    self_penetration_m: Floats
    """(N,)"""
    overflow: NDArray[np.bool_]
    """(N,) whether contacts or constraints were dropped for lack of memory."""
    ticks: NDArray[np.int32]
    """(N,) simulated ticks, of `protocol.INTERVAL_S` each."""

    @property
    def held(self) -> NDArray[np.bool_]:
        """(N,) whether all six pushes were held, clearly or not."""
        return np.asarray((self.outcome == Outcome.HELD).all(axis=1))

    @property
    def clearly_held(self) -> NDArray[np.bool_]:
        """(N,) whether the grasp held with a clear margin."""
        return np.asarray(self.held & (self.margin < BAND[0]) & ~self.overflow)

    @property
    def clearly_failed(self) -> NDArray[np.bool_]:
        """(N,) whether the object is lost, or the hand starts inside it."""
        inside = self.outcome[:, 0] == Outcome.PENETRATION
        kinds = (Outcome.LOST_WHILE_CLOSING, Outcome.DISPLACED, Outcome.ROTATED)
        lost = np.isin(self.outcome, kinds).any(axis=1) & np.isfinite(self.margin) & (self.margin > BAND[1])
        return np.asarray((inside | lost) & ~self.overflow)

    @staticmethod
    def terms(engine: str) -> list[Any]:
        """Return the terms of verdicts by a version of the engine, besides those of level standard."""
        return [engine, REVISION, *BAND, PATIENCE, MOST_TICKS, RECHECK_ONE_IN]

    def put(self, rows: NDArray[np.intp], again: Self) -> Self:
        changed: dict[str, Any] = {}
        for field in fields(self):
            changed[field.name] = getattr(self, field.name).copy()
            changed[field.name][rows] = getattr(again, field.name)
        return replace(self, **changed)
