"""What a task gets besides its message, and what its worker counts.

Engines and drivers leak: a worker that grew makes room for a new one.
"""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.model.cores import available_memory
from service.model.states import Stage
from service.queue.port import Report
from service.store.store import Store
from worker.engines.devices import Device
from worker.engines.joins import batches_at_once, parse_join
from worker.pool.pool import MODULES, Pool, processes_at_once
from worker.run import Run
from worker.stages.context import TaskContext

if TYPE_CHECKING:
    from service.settings import Settings


class Surroundings:
    """What a task gets besides its message."""

    def __init__(self, settings: Settings, store: Store, device: Device) -> None:
        self.settings = settings
        self.store = store
        self._device = device
        self._memory_mb = settings.worker_max_memory_mb or available_memory() / 2 / 2**20
        self.tasks_done = 0
        self._pool: Pool | None = None
        self._processes = 0

    def outgrown(self) -> str:
        """Why this process should make room for a fresh one, "" if it need not."""
        most = self.settings.worker_max_tasks
        if most and self.tasks_done >= most:
            return f"it has done {self.tasks_done} tasks (GRASPD_WORKER_MAX_TASKS)"
        beside = sum(resident_mb(pid) for pid in self._pool.pids) if self._pool is not None else 0.0
        if (held := resident_mb() + beside) > self._memory_mb:
            return f"it holds {held:.0f} MiB, over {self._memory_mb:.0f} (GRASPD_WORKER_MAX_MEMORY_MB)"
        return ""

    @cached_property
    def _join(self) -> int:
        """Batches that one launch plans on the device; waits until that is known."""
        return batches_at_once(self._device.resolve(), parse_join(self.settings.join))

    def pool(self, stage: str) -> Pool | None:
        """The processes that judge and measure, if a task of this stage has work for them; waits until it is known how
        many they are."""
        if stage != Stage.SYNTHESIZE:
            return None
        if not self._processes:
            chosen = self.settings
            self._processes = processes_at_once(
                self._device.resolve(), chosen.processes, threads=chosen.threads, workers=chosen.workers_here
            )
            self._pool = Pool(self._processes, MODULES) if self._processes > 1 else None
        if self._pool is not None:
            self._pool.start()
        return self._pool

    def close(self) -> None:
        """End what was started for tasks."""
        if self._pool is not None:
            self._pool.close()

    def context(self, raw: Mapping[str, Any], report: Callable[[str, Report], None]) -> TaskContext:
        """The context of a task, whose progress goes to `report`."""

        def tell(done: float, total: float, message: str) -> None:
            report(raw["task_id"], Report(attempt=raw["attempt"], done=done, total=total, message=message[:200]))

        stage, chosen = raw.get("stage", ""), self.settings
        device = "cpu" if stage == Stage.INGEST else self._device.resolve()
        run = Run(device, chosen.threads, first_judge=chosen.first_judge, pool=self.pool(stage))
        return TaskContext(self.store, run, join=self._join if stage == Stage.SYNTHESIZE else 1, tell=tell)


def resident_mb(pid: int | None = None) -> float:
    """Resident memory of this process, or of another [MiB]; where the system does not tell, the most this one ever
    had, or nothing of another."""
    try:
        pages = int(Path(f"/proc/{pid or 'self'}/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        if pid is not None:
            return 0.0
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (2**20 if sys.platform == "darwin" else 2**10)
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
