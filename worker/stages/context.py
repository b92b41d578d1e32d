"""What a stage knows of the task it does: where to read, where to say how far it is, and whether to stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from service.model.errors import TaskCancelled
from worker.run import ALONE, Run

if TYPE_CHECKING:
    from service.store.store import Store

#: Least time between two reports [s]: as often as the controller passes them on.
REPORT_EVERY_S: Final = 0.5


class StopReason(StrEnum):
    """Why a running task should stop."""

    CANCELLED = "cancelled"
    LEASE_LOST = "lease lost"
    SHUTDOWN = "shutdown"
    TIMEOUT = "timeout"


class TaskContext:
    """One task's surroundings. `progress` and `cancelled` may be called from any thread and are cheap."""

    def __init__(
        self,
        store: Store,
        run: Run = ALONE,
        *,
        join: int = 1,
        tell: Callable[[float, float, str], None] | None = None,
    ) -> None:
        """`join` is how many batches one launch plans; `tell` takes done, total and a message."""
        self.store, self.device, self.join = store, run.device, join
        self.run = replace(run, progress=self.progress, cancelled=self.cancelled)
        """What the engine room needs to know of the task."""
        self._tell = tell
        self._tell_again = 0.0
        self._stop = threading.Event()
        self._reason: StopReason | None = None

    def progress(self, done: float, total: float, message: str) -> None:
        """Say how far the task is; most calls are dropped so that few are sent."""
        now = time.monotonic()
        if self._tell is not None and now >= self._tell_again:
            self._tell_again = now + REPORT_EVERY_S
            self._tell(done, total, message)

    def cancelled(self) -> bool:
        """Whether to stop at the next launch."""
        return self._stop.is_set()

    def check(self) -> None:
        """Raises TaskCancelled if the task should stop."""
        if self._stop.is_set():
            raise TaskCancelled(f"stopped: {self._reason}")

    def stop(self, reason: StopReason) -> None:
        """Ask the task to stop; the first reason stands."""
        if self._reason is None:
            self._reason = reason
        self._stop.set()

    @property
    def stop_reason(self) -> StopReason | None:
        return self._reason
