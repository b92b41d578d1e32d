"""How much of its range each joint of a hand uses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Bins between a joint's limits.
BINS: Final = 200
#: A joint is at a limit where it is nearer than this share of its range.
_AT: Final = 0.01


@dataclass
class JointUse:
    """Histograms of the joints of one hand between their limits; joints without known limits are left out."""

    names: tuple[str, ...]
    lower: Floats
    upper: Floats
    counts: NDArray[np.int64]
    """(J, BINS) grasps."""

    @classmethod
    def of(cls, names: tuple[str, ...], facts: Mapping[str, Any]) -> JointUse:
        """Nothing yet, for those joints that the facts of the hand give limits for."""
        lower, upper = dict(facts.get("lower", {})), dict(facts.get("upper", {}))
        known = tuple(name for name in names if name in lower and upper[name] > lower[name])
        return cls(
            known,
            np.array([lower[name] for name in known]),
            np.array([upper[name] for name in known]),
            np.zeros((len(known), BINS), np.int64),
        )

    def add(self, names: tuple[str, ...], positions: Floats) -> None:
        """Grasps (N, joints) of these names; a position outside the limits counts at the limit."""
        for row, name in enumerate(self.names):
            if name not in names:
                continue
            share = (positions[:, names.index(name)] - self.lower[row]) / (self.upper[row] - self.lower[row])
            places = np.clip((share * BINS).astype(np.int64), 0, BINS - 1)
            self.counts[row] += np.bincount(places, minlength=BINS)

    def shares(self) -> dict[str, dict[str, float]]:
        """Of each joint, as shares of its range: 5, 50 and 95 percentile, what lies between 1 and 99 percent of the
        grasps (`used`); and the shares of grasps at its lower and upper limit."""
        found = {}
        near = max(1, round(_AT * BINS))
        for name, counts in zip(self.names, self.counts, strict=True):
            if not (total := int(counts.sum())):
                continue
            below = np.cumsum(counts) / total
            low, p5, middle, p95, high = (
                (np.searchsorted(below, q) + 0.5) / BINS for q in (0.01, 0.05, 0.5, 0.95, 0.99)
            )
            found[name] = {
                "p5": float(p5),
                "median": float(middle),
                "p95": float(p95),
                "used": float(high - low),
                "at_lower": float(counts[:near].sum() / total),
                "at_upper": float(counts[-near:].sum() / total),
            }
        return found
