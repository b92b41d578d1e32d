"""Several keepers, of which one works: it holds a lease in Redis, and where it falls silent another takes over.

Two that both believe to lead, one of them having been stopped for longer than its lease, do no harm for the moment that
it lasts: what they write follows from facts in the store, a task is queued once for each attempt, and writers of the
index take turns.
"""

from __future__ import annotations

import logging
import os
import secrets
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from service.heartbeat_file import HeartbeatFile
from service.model.errors import QueueUnavailable
from service.queue.port import Presence

log = logging.getLogger(__name__)
#: So many renewals fit a lease.
_RENEWALS: Final = 3


class Leadership:
    """The lease of a part of the service, as one process wants and holds it."""

    def __init__(
        self, queue: Presence, part: str, *, lease_s: float, alive: HeartbeatFile, name: str | None = None
    ) -> None:
        """
        Args:
            queue: used by a thread of its own while the lease is held.
            alive: touched while another leads.
            name: under which it leads; one that is started again under the same name need not wait for its lease.
        """
        self._queue, self._part, self._lease_s = queue, part, lease_s
        self._alive = alive
        self.holder = name or f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"

    def wait(self, stop: threading.Event) -> bool:
        """Until this process leads; False if it is told to stop first. Redis may be away meanwhile."""
        told = False
        while not stop.is_set():
            self._alive.touch()
            try:
                if self._queue.lead(self._part, self.holder, self._lease_s):
                    log.info("this %s leads", self._part)
                    return True
                if not told:
                    log.info("another %s leads; this one waits to take over", self._part)
                told = True
            except QueueUnavailable as error:
                log.warning("%s", error)
            stop.wait(self._lease_s / _RENEWALS)
        return False

    @contextmanager
    def held(self, stop: threading.Event) -> Iterator[threading.Event]:
        """Keep the lease; gives an event that is set once it is lost, or `stop` is. Given back at the end.

        It is lost only where Redis says that another has it: while Redis is away nobody else can take it.
        """
        over = threading.Event()
        thread = threading.Thread(target=self._renew, args=(stop, over), name=f"lead-{self._part}", daemon=True)
        thread.start()
        try:
            yield over
        finally:
            ended = over.is_set() and not stop.is_set()
            over.set()
            thread.join(self._lease_s)
            if not ended:
                self._resign()

    def _renew(self, stop: threading.Event, over: threading.Event) -> None:
        while not over.is_set():
            # Told to stop, it keeps the lease until the work is laid down: then `held` gives it back.
            if stop.is_set():
                over.set()
                return
            try:
                if not self._queue.lead(self._part, self.holder, self._lease_s):
                    log.warning("this %s was silent for too long, and another leads now", self._part)
                    over.set()
                    return
            except QueueUnavailable:
                log.debug("the lease of the %s cannot be renewed now", self._part)
            stop.wait(self._lease_s / _RENEWALS)

    def _resign(self) -> None:
        try:
            self._queue.resign(self._part, self.holder)
        except QueueUnavailable:
            log.debug("the lease of the %s runs out by itself", self._part)
