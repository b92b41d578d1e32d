"""Number of batches per task of a job: long enough to fill a worker, at most a fair share."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Final

from graspd.service.index.queries.overview import BatchCost
from graspd.service.index.queries.rates import Rates, candidates
from graspd.service.model.domain import batches_of
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.records import MOST_BATCHES, JobRecord
from graspd.service.model.states import Priority, Stage
from graspd.service.model.version import SCHEMA_OF_RANGES
from graspd.service.model.workers import WorkerBeat
from graspd.service.pipeline.backends import Services

#: Finished tasks that are used to measure the time of a batch.
_LOOKED_AT: Final = 64
#: Workers assumed if none is present: a service may start them once a task waits.
_EXPECTED: Final = 8
#: Cache lifetime of measured workers and rates [s].
_KNOWN_S: Final = 10.0


class TaskRanges:
    def __init__(
        self, services: Services, *, scope: ProjectScope = EVERYTHING, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`scope` limits the measurements that count."""
        self._services, self._scope, self._clock = services, scope, clock
        self._read_again = -math.inf
        self._workers: list[WorkerBeat] = []
        self._costs: list[BatchCost] = []

    def sized(self, job: JobRecord, *, among: int = 1) -> JobRecord:
        """Return a job with its number of batches per task, if `among` jobs share the workers."""
        batches, wanted_s = batches_of(job.request.grasps), self._services.settings.task_s
        # Pictures of a batch are already a file of megabytes.
        if batches == 1 or job.request.views or not wanted_s:
            return job
        if self._clock() >= self._read_again:
            self._workers = self._services.queue.workers()
            self._costs = self._services.index.costs.of_batches(Stage.SYNTHESIZE, limit=_LOOKED_AT, scope=self._scope)
            self._read_again = self._clock() + _KNOWN_S
        able = [worker for worker in self._workers if Stage.SYNTHESIZE in worker.stages]
        if any(worker.ability.schemas[1] < SCHEMA_OF_RANGES for worker in able):
            return job
        # A small job shows its grasps batch by batch; a GPU makes them all in one launch.
        if job.priority is Priority.INTERACTIVE and not (able and all(one.device.startswith("cuda") for one in able)):
            return job
        rate = Rates(self._costs, job.request, {one.device for one in able}).of(job.request.hand, job.request.object)
        batch_s = rate.seconds_per_try * candidates(rate, job.request) / batches
        by_time = int(wanted_s / max(1e-3, batch_s or wanted_s))
        workers = -(-(len(able) or _EXPECTED) // among)
        return job.model_copy(update={"span": span_of(batches, by_time, workers)})


def span_of(batches: int, by_time: int, workers: int) -> int:
    """Return the batches per task of a job; `by_time` batches last the target duration of a task.

    All tasks but the last have equal length, and no worker is idle while another has two tasks.
    """
    most = max(1, min(by_time, MOST_BATCHES, -(-batches // max(1, workers))))
    return -(-batches // -(-batches // most))
