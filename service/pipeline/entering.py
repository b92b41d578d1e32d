"""Enters the tasks of large jobs piece by piece, beside the controller's rounds: others write between the pieces."""

from __future__ import annotations

import logging
import threading
import time
from typing import Final

from service.model import names
from service.model.errors import DamagedError, NotFoundError, UnavailableError
from service.model.records import JobRecord
from service.pipeline.backends import Services
from service.store.records import read_record

log = logging.getLogger(__name__)
#: Wait for a job that is to be entered [s].
_PAUSE_S: Final = 0.5
#: Least wait between two pieces [s]: longer than SQLite lets a waiting writer sleep.
_GAP_S: Final = 0.15


class Entering:
    """Killed at any moment, its successor goes on: a note in the index says where."""

    def __init__(self, services: Services, stop: threading.Event) -> None:
        self._services = services
        self._stop = stop

    def run(self) -> None:
        """Until told to stop. The index is free for at least as long as it was held."""
        pause = 0.0
        while not self._stop.wait(pause):
            pause = _PAUSE_S
            try:
                for job in self._services.index.write.entering():
                    start = time.monotonic()
                    self.enter(job)
                    pause = max(_GAP_S, time.monotonic() - start)
                    if self._stop.wait(pause):
                        return
            except UnavailableError as error:
                log.warning("large jobs wait: %s", error)
            except Exception:
                log.exception("entering a large job broke off")

    def enter(self, job: str) -> None:
        """The next piece of a job."""
        record = None
        try:
            record = read_record(JobRecord, self._services.store, names.job_record(job))
        except (NotFoundError, DamagedError) as error:
            log.error("the rest of job %s is not entered: %s", job, error)
        self._services.index.write.enter_more(job, record)
