"""Waiting for a fact, for as long as a machine that is busy with other things may need."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

#: Longest wait: what takes a second on a quiet machine has come by then on any [s].
PATIENCE_S: Final = 120.0


def until(met: Callable[[], Any], what: str, *, seconds: float = PATIENCE_S, logs: Callable[[], str] = str) -> None:
    """Until a condition is met; fails with what was waited for, and the logs, when it does not come."""
    end = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < end, f"after {seconds:g} s still not: {what}\n{logs()}"
        time.sleep(0.02)
