"""The context of a piece of work: device, progress, cancellation, and the threads that share its cores."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Literal

from graspd.service.model.cores import available_cores
from graspd.service.model.errors import TaskCancelled
from graspd.worker.pool.pool import Pool

PrefilterMode = Literal["auto", "on", "off"]
Progress = Callable[[float, float, str], None]

"""Told what is done, of how much, and a word on it; from any thread, often."""

Cancelled = Callable[[], bool]

"""Asked often, from any thread: whether to stop."""


def _silent(done: float, total: float, message: str) -> None:
    """Progress that nobody wants to know."""


def _never() -> bool:
    return False


class Lanes:
    """How many lanes share the cores; one that ends leaves its own to the others."""

    def __init__(self, members: int) -> None:
        self.members = members
        self._lock = threading.Lock()

    def leave(self) -> None:
        """One lane needs no cores any more."""
        with self._lock:
            self.members -= 1


@dataclass(frozen=True)
class ExecutionContext:
    """Where and how work is done; what it makes does not depend on it, but for the rounding of a GPU and who
    validates."""

    device: str = "cpu"
    """Warp device."""
    threads: int = 0
    """CPU threads; 0: one per core this process may use."""
    progress: Progress = _silent
    cancelled: Cancelled = _never
    prefilter: PrefilterMode = "auto"
    """Whether MuJoCo Warp gives the clear verdicts; auto: on a GPU, where it is installed."""
    pool: Pool | None = None
    """Processes that validate and measure; None: threads of this one."""
    lanes: Lanes | None = None
    """Those beside which it is one; None: all cores are its own."""

    @property
    def cores(self) -> int:
        """CPU threads, the default counted: a fair share of them where others work beside it."""
        every = self.threads or available_cores()
        return every if self.lanes is None else max(1, every // max(1, self.lanes.members))

    def part(self, start: float, end: float) -> ExecutionContext:
        """The same for a part of the work, whose progress goes from share `start` to share `end` of the whole."""

        def tell(done: float, total: float, message: str) -> None:
            self.progress(start + (end - start) * (done / total if total > 0 else 0.0), 1.0, message)

        return replace(self, progress=tell)

    def quiet(self) -> ExecutionContext:
        """The same for a part of the work that is too short, or too hard to foresee, to tell of."""
        return replace(self, progress=_silent)

    def check(self, what: str) -> None:
        """Raises TaskCancelled if the work should stop."""
        if self.cancelled():
            raise TaskCancelled(f"{what} was cancelled")


class Count:
    """Grasps that are done of a whole, told as they are counted by any thread."""

    def __init__(self, total: int, run: ExecutionContext, what: str, done: int = 0) -> None:
        self._total, self._run, self._what, self._done = total, run, what, done
        self._lock = threading.Lock()

    def add(self, more: int) -> None:
        """So many more are done."""
        with self._lock:
            self._done += more
            self._run.progress(self._done, self._total, self._what)


#: On the CPU with all its cores; nobody is told, nobody stops it.
DEFAULT_CONTEXT: Final = ExecutionContext()
