"""How far a measured share can be trusted."""

from __future__ import annotations

from scipy.stats import binomtest


def wilson(part: int, whole: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927): of none or all, where a bootstrap sees no spread, it is not empty.

    Raises:
        ValueError: `whole` is 0, or less than `part`.
    """
    bounds = binomtest(part, whole).proportion_ci(method="wilson")
    return float(bounds.low), float(bounds.high)
