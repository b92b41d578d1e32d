"""From the workers' reports to the progress that the index shows."""

from __future__ import annotations

from collections.abc import Collection

from service.pipeline.backends import Services
from service.queue.port import Report


class Reports:
    """Passes on what changed."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._known: dict[str, Report] = {}

    def take_up(self) -> None:
        """Progress of the running tasks into the index."""
        found = self._services.queue.reports()
        changed = {task: report for task, report in found.items() if self._known.get(task) != report}
        if changed:
            self._services.index.live.set_progress({task: (r.done, r.total, r.message) for task, r in changed.items()})
        self._known = found

    def sweep(self, held: Collection[str]) -> None:
        """Take away reports that were read before the leases were, and whose tasks nobody held then."""
        gone = self._known.keys() - set(held)
        if gone:
            self._services.queue.forget_reports(gone)
            for task in gone:
                del self._known[task]
