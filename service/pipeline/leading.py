"""Leader election of controllers by a lease in Redis; the others wait.

Two processes may both lead briefly if one was suspended for longer than its lease. This does no harm: writes are
idempotent, a task is queued once per attempt, and writers of the index run one at a time.
"""

from __future__ import annotations

import logging
import math
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final

from graspd.service.model.errors import QueueUnavailable
from graspd.service.telemetry import HeartbeatFile

if TYPE_CHECKING:
    from graspd.service.queue.rq_queue import RqQueue

log = logging.getLogger(__name__)
#: Name of the leading controller's registration, which an API of graspd 0.2 expects.
PART: Final = "keeper"
_RENEWALS: Final = 3.0
_LOOK_S: Final = 0.1


class Leadership:
    def __init__(self, queue: RqQueue, *, lease_s: float, alive: HeartbeatFile, name: str | None = None) -> None:
        """`alive` is touched while another process leads. A restarted process of the same name leads at once."""
        self._queue, self._lease_s, self._alive = queue, lease_s, alive
        self.holder = name or f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"

    def wait(self, stop: threading.Event) -> bool:
        """Wait until this process leads; return False if `stop` is set first. Redis may be unavailable."""
        told = False
        while not stop.is_set():
            self._alive.touch()
            if (leads := self._renew_lease()) is True:
                log.info("this controller leads")
                return True
            if leads is False and not told:
                log.info("another controller leads; this one waits to take over")
                told = True
            stop.wait(self._lease_s / _RENEWALS)
        return False

    @contextmanager
    def hold(self, stop: threading.Event) -> Iterator[threading.Event]:
        """Renew the lease in a thread; yield an event that is set with `stop`, or once another process leads.

        While Redis is unavailable, the lease continues, because no other process can take it.
        """
        over, done = threading.Event(), threading.Event()
        thread = threading.Thread(target=self._renew, args=(stop, over, done), name="controller-lease", daemon=True)
        thread.start()
        try:
            yield over
        finally:
            over.set()
            done.set()
            thread.join(self._lease_s)
            if stop.is_set():
                with suppress(QueueUnavailable):  # The lease expires by itself.
                    self._queue.resign(self.holder)

    def _renew(self, stop: threading.Event, over: threading.Event, done: threading.Event) -> None:
        due = -math.inf  # Renewal continues while the work stops.
        while not done.wait(_LOOK_S) and not stop.is_set():
            if time.monotonic() < due:
                continue
            if self._renew_lease() is False and not over.is_set():
                log.warning("this controller was silent for too long, and another leads now")
                over.set()
            due = time.monotonic() + self._lease_s / _RENEWALS
        if stop.is_set():
            over.set()

    def _renew_lease(self) -> bool | None:
        """Return whether this process leads for the next lease; None if Redis is unavailable."""
        try:
            return self._queue.renew_leadership(self.holder, self._lease_s)
        except QueueUnavailable as error:
            log.debug("it is unknown which controller leads: %s", error)
            return None
