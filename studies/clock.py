"""Clock of the studies."""

from __future__ import annotations

import time
from collections.abc import Callable


def clock_of(device: str) -> Callable[[], float]:
    """Return core-seconds of all threads on a CPU (nearly independent of load), wall clock on a GPU."""
    return time.process_time if device == "cpu" else time.perf_counter
