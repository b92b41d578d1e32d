"""Confidence intervals of measured shares."""

import math
from typing import Final

from scipy.stats import binomtest

_Z: Final = 1.959963984540054  # quantile of the normal distribution that leaves 2.5 % above


def wilson_interval(part: int, whole: int) -> tuple[float, float]:
    """Return the 95 % interval of the share `part` / `whole` (Wilson 1927).
    At shares 0 and 1 its width is above 0, unlike a bootstrap's. Raises ValueError: `whole` is 0 or below `part`."""
    bounds = binomtest(part, whole).proportion_ci(method="wilson")
    return float(bounds.low), float(bounds.high)


def wilson_interval_of_mean(total: float, count: int) -> tuple[float, float]:
    """Return the 95 % interval of the mean of `count` values from 0 to 1 that sum to `total`.
    Wilson's interval for a share is wide enough: of all values from 0 to 1, zeros and ones spread most."""
    mean, grown = total / count, 1 + _Z**2 / count
    middle = (mean + _Z**2 / (2 * count)) / grown
    half = _Z / grown * math.sqrt(max(0.0, mean * (1 - mean)) / count + _Z**2 / (4 * count**2))
    return max(0.0, middle - half), min(1.0, middle + half)
