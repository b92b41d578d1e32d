"""Several keepers: each holds leases in Redis on shards of the work, as many as are fair given who else is there.

With one shard, which is the default, one keeper works and the others wait. Where one falls silent, the others take its
shards when their leases run out; where one comes, those with more than their share lay down their work and give back.

Two that both believe to hold a shard, one of them having been stopped for longer than its lease, or told another number
of shards, do no harm for the moment that it lasts: what they write follows from facts in the store, a task is queued
once for each attempt, and writers of the index take turns.
"""

from __future__ import annotations

import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from service.heartbeat_file import HeartbeatFile
from service.model.errors import QueueUnavailable
from service.model.keeper_shards import KeeperShards
from service.queue.port import Presence, Share

log = logging.getLogger(__name__)
#: As what keepers announce themselves.
PART: Final = "keeper"
#: So many renewals fit a lease.
_RENEWALS: Final = 3.0
#: How long it may take until a process that is told to stop hears it [s].
_LOOK_S: Final = 0.1
_NOTHING: Final = frozenset[int]()


def is_kept(queue: Presence) -> bool:
    """Whether every shard has a keeper that gave a sign of life lately."""
    return all(one.works for one in queue.keepers(PART))


class Sharing:
    """The shards of the work that one process wants and holds."""

    def __init__(
        self, queue: Presence, *, number: int, lease_s: float, alive: HeartbeatFile, name: str | None = None
    ) -> None:
        """
        Args:
            queue: used by a thread of its own while shards are held.
            number: of shards that the work is cut into.
            alive: touched while others have all of them.
            name: under which it holds them; one that is started again under the same name need not wait for its leases.
        """
        self._queue, self._number, self._lease_s = queue, number, lease_s
        self._alive = alive
        self._mine = _NOTHING
        self.holder = name or f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"

    def wait(self, stop: threading.Event) -> KeeperShards | None:
        """Until this process holds shards, no more than are fair; None if it is told to stop first. Redis may be away
        meanwhile."""
        told = ""
        while not stop.is_set():
            self._alive.touch()
            try:
                share = self._share()
                if surplus := self._surplus(share):
                    self._queue.resign(self.holder, surplus)
                    continue
                if share.held:
                    self._mine = share.held
                    held = KeeperShards(self._number, share.held)
                    log.info("%s", "this keeper leads" if self._number == 1 else f"this keeper has {held}")
                    return held
                if told != (told := self._why_none(share)):
                    log.info("%s", told)
            except QueueUnavailable as error:
                log.warning("%s", error)
            stop.wait(self._lease_s / _RENEWALS)
        self._leave()
        return None

    @contextmanager
    def held(self, stop: threading.Event) -> Iterator[threading.Event]:
        """Keep the shards; gives an event that is set once they are to be others, or `stop` is. Stopped, it gives all
        back.

        They are lost only where Redis says that another has them: while Redis is away nobody else can take them.
        """
        over, done = threading.Event(), threading.Event()
        thread = threading.Thread(target=self._renew, args=(stop, over, done), name="keeper-shards", daemon=True)
        thread.start()
        try:
            yield over
        finally:
            over.set()
            done.set()
            thread.join(self._lease_s)
            if stop.is_set():
                self._leave()

    def _renew(self, stop: threading.Event, over: threading.Event, done: threading.Event) -> None:
        # Also while the work is laid down.
        while not done.is_set():
            try:
                share = self._share()
                if share.held != self._mine or self._surplus(share):
                    self._tell(share, over)
                    over.set()
            except QueueUnavailable:
                log.debug("the leases of the keeper cannot be renewed now")
            end = time.monotonic() + self._lease_s / _RENEWALS
            while not (stop.is_set() or done.wait(_LOOK_S)) and time.monotonic() < end:
                pass
            if stop.is_set():
                over.set()
                return

    def _share(self) -> Share:
        return self._queue.take_share(self.holder, self._lease_s, number=self._number, before=self._mine)

    def _surplus(self, share: Share) -> frozenset[int]:
        """Shards to be given back; the first is kept longest."""
        return frozenset(sorted(share.held)[share.fair :])

    def _tell(self, share: Share, over: threading.Event) -> None:
        if over.is_set():
            return
        if share.number == self._number and not self._mine <= share.held:
            log.warning("this keeper was silent for too long, and another leads now")
        elif self._number > 1:
            log.info("the shards are shared out anew")

    def _why_none(self, share: Share) -> str:
        if share.number != self._number:
            others = "1 shard" if share.number == 1 else f"{share.number} shards"
            return f"another keeper leads, with {others}; this one, told {self._number}, waits until it ends"
        if self._number == 1:
            return "another keeper leads; this one waits to take over"
        return f"other keepers have all {self._number} shards; this one waits to take over"

    def _leave(self) -> None:
        try:
            self._queue.resign(self.holder, self._mine)
            self._queue.leave(self.holder, number=self._number)
        except QueueUnavailable:
            log.debug("the leases of the keeper run out by themselves")
        self._mine = _NOTHING
