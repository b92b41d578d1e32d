"""Users' actions on datasets, a part in each round of the controller: plan, cancel and retry jobs.

The index records which cells have a job, and a job's event names the causing event of the dataset. Another controller
can therefore continue without applying an event twice.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Final

from graspd.service.index.queries.feed import DatasetWork
from graspd.service.model.errors import ConflictError
from graspd.service.model.records import job_of
from graspd.service.model.states import State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.ranges import TaskRanges
from graspd.service.store.records import job_events

log = logging.getLogger(__name__)
#: Most time for datasets in one round of the controller [s], because queue and lost workers must not wait long.
BUDGET_S: Final = 0.5
_CELLS_AT_ONCE: Final = 20


class DatasetRounds:
    def __init__(self, services: Services, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._services = services
        self._clock = clock
        self._ranges = TaskRanges(services, clock=clock)
        self._positions: dict[tuple[str, int], int] = {}

    def advance(self, budget_s: float = BUDGET_S) -> bool:
        """Work for at most `budget_s`; return whether work is left."""
        deadline = self._clock() + budget_s
        for work in self._services.index.dataset_feed.in_work():
            if not self._apply_event(work, deadline) or not self._plan(work, deadline):
                return True
        return False

    def _plan(self, work: DatasetWork, deadline: float) -> bool:
        """Make jobs for the cells without a job; return whether all are made."""
        after = -1
        while not work.cancelled:
            cells = self._services.index.dataset_feed.cells_to_plan(work.name, after=after, limit=_CELLS_AT_ONCE)
            for cell in cells:
                if self._clock() > deadline:
                    return False
                job = job_of(cell, work.options, work.revisions, work.owner, work.project)
                job_actions.enter(self._services, self._ranges.sized(job, among=len(cells)), keeps_assets=True)
                after = cell.position
            if not cells:
                break
        self._services.index.write_dataset.set_progress(work.name, planned=True)
        return True

    def _apply_event(self, work: DatasetWork, deadline: float) -> bool:
        """Cancel or retry the jobs according to the last event; return whether all are done."""
        if work.applied >= work.events:
            return True
        key = (work.name, work.events)
        states = (State.QUEUED, State.RUNNING) if work.cancelled else (State.FAILED, State.CANCELLED)
        while True:
            found = self._services.index.dataset_feed.cells_in_states(
                work.name, states, after=self._positions.get(key, -1), limit=_CELLS_AT_ONCE, unshared=work.cancelled
            )
            for position, job in found:
                if self._clock() > deadline:
                    return False
                self._apply_to_job(job, work)
                self._positions[key] = position
            if not found:
                break
        self._positions.pop(key, None)
        self._services.index.write_dataset.set_progress(work.name, applied=work.events)
        return True

    def _apply_to_job(self, job: str, work: DatasetWork) -> None:
        cause = f"{work.name}/{work.events}"
        if any(event.cause == cause for event in job_events(self._services.store, job)):
            return
        act = job_actions.cancel if work.cancelled else job_actions.retry
        try:
            act(self._services, job, cause=cause)
        except ConflictError as error:
            # The job ended or was restarted since the query of the index.
            log.info("job %s of dataset %s is unchanged: %s", job, work.name, error)
