"""How often workers speak, so that what Redis and the controller hear does not grow with their number."""

from __future__ import annotations

from typing import Final

#: Signs of life of all workers together [1/s]; each is three round trips, of thirteen commands.
_BEATS_PER_S: Final = 2500.0
#: A cancelled task must stop within two seconds, so where there is room the key that says so is read twice in them.
_LEAST_BEAT_S: Final = 0.8
#: Reports on how far tasks are, of all workers together [1/s]; the controller writes as many rows.
_REPORTS_PER_S: Final = 500.0
#: Enough for a smooth bar.
_LEAST_REPORT_S: Final = 0.25


def beat_every_s(workers: int, lease_s: float) -> float:
    """Time between two signs of life of one of so many workers [s]; three fit a lease."""
    return min(max(_LEAST_BEAT_S, workers / _BEATS_PER_S), lease_s / 3)


def report_every_s(workers: int) -> float:
    """Time between two reports on a task by one of so many workers [s]."""
    return max(_LEAST_REPORT_S, workers / _REPORTS_PER_S)
