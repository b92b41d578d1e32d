"""What studies read the time from."""

from __future__ import annotations

import time
from collections.abc import Callable


def clock_of(device: str) -> Callable[[], float]:
    """On a CPU the seconds of all threads together, which hardly depend on what else the machine does; on a GPU those
    that pass."""
    return time.process_time if device == "cpu" else time.perf_counter
