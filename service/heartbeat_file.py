"""A file that a process touches while it lives: a health check is then a look at its age, and no process of ours."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Final

log = logging.getLogger(__name__)
#: Far below the minute after which a check calls the process dead.
_EVERY_S: Final = 5.0


class HeartbeatFile:
    """Touched at most every few seconds, however often it is asked to."""

    def __init__(self, path: Path | None) -> None:
        """`path` is None where nobody looks."""
        self._path = path
        self._again = 0.0

    def touch(self) -> None:
        """Say that this process lives. A disk without room is said once, and ends nothing."""
        now = time.monotonic()
        if self._path is None or now < self._again:
            return
        self._again = now + _EVERY_S
        try:
            self._path.touch()
        except OSError as error:
            log.warning("health checks will miss this process: %s cannot be touched (%s)", self._path, error.strerror)
            self._path = None
