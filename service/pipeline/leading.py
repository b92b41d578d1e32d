"""Of several controllers one leads, by a lease in Redis, and the others stand by.

Two that both believe to lead, one of them having been stopped for longer than its lease, do no harm for the moment that
it lasts: what they write follows from facts in the store, a task is queued once for each attempt, and writers of the
index take turns.
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
#: As what the controller that leads announces itself; an API of graspd 0.2 looks for the same name.
PART: Final = "keeper"
#: So many renewals fit a lease.
_RENEWALS: Final = 3.0
#: How long it may take until a process that is told to stop hears it [s].
_LOOK_S: Final = 0.1


class Leadership:
    """The lease that one process wants and holds."""

    def __init__(self, queue: RqQueue, *, lease_s: float, alive: HeartbeatFile, name: str | None = None) -> None:
        """
        Args:
            queue: used by a thread of its own while the lease is held.
            lease_s: how long the lease outlives its last renewal [s].
            alive: touched while another leads.
            name: under which it leads; one that is started again under the same name need not wait for its lease.
        """
        self._queue, self._lease_s, self._alive = queue, lease_s, alive
        self.holder = name or f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"

    def wait(self, stop: threading.Event) -> bool:
        """Until this process leads; False if it is told to stop first. Redis may be away meanwhile."""
        told = False
        while not stop.is_set():
            self._alive.touch()
            if (leads := self._leads()) is True:
                log.info("this controller leads")
                return True
            if leads is False and not told:
                log.info("another controller leads; this one waits to take over")
                told = True
            stop.wait(self._lease_s / _RENEWALS)
        return False

    @contextmanager
    def held(self, stop: threading.Event) -> Iterator[threading.Event]:
        """Keep the lease; gives an event that is set once another leads, or `stop` is; stopped, gives it back.

        The lease is lost only where Redis says that another has it: while Redis is away nobody else can take it.
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
                with suppress(QueueUnavailable):  # the lease runs out by itself
                    self._queue.resign(self.holder)

    def _renew(self, stop: threading.Event, over: threading.Event, done: threading.Event) -> None:
        due = -math.inf  # also while the work is laid down
        while not done.wait(_LOOK_S) and not stop.is_set():
            if time.monotonic() < due:
                continue
            if self._leads() is False and not over.is_set():
                log.warning("this controller was silent for too long, and another leads now")
                over.set()
            due = time.monotonic() + self._lease_s / _RENEWALS
        if stop.is_set():
            over.set()

    def _leads(self) -> bool | None:
        """Whether this process leads, for as long as a lease lasts; None: Redis is away."""
        try:
            return self._queue.lead(self.holder, self._lease_s)
        except QueueUnavailable as error:
            log.debug("nobody knows which controller leads: %s", error)
            return None
