"""A worker's registration: that it lives, and what it is at."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from redis.exceptions import RedisError

from graspd.service.model.clock import timestamp
from graspd.service.model.workers import WorkerBeat
from graspd.service.queue.connection import connect
from graspd.service.queue.port import Event, EventKind
from graspd.service.queue.rq_queue import list_worker, unlist_worker
from graspd.service.telemetry import HeartbeatFile

log = logging.getLogger(__name__)
#: Time between two signs of life, where three of them fit a lease [s]: a cancelled task must stop within two seconds,
#: and the key that says so is read with each.
BEAT_S: Final = 0.8
#: News is not told more often than this [s].
_SHORTEST_INTERVAL_S: Final = 0.1
#: Longest wait for an answer of Redis [s].
_ANSWER_S: Final = 3.0


class Heartbeat:
    """Beats from a thread of its own, on a connection of its own: both are free while the worker waits for others."""

    def __init__(
        self,
        url: str,
        beat: WorkerBeat,
        *,
        lease_s: float,
        alive: Path | None = None,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """
        Args:
            url: of Redis.
            beat: what the list of workers shows at first.
            lease_s: how long the registration outlives a beat [s].
            alive: a file that is touched with each beat.
            is_stopped: whether the worker does not go on, though this thread does: then there is no beat.
        """
        self._connection: Any = connect(url, patience=0, timeout_s=_ANSWER_S)
        self._facts, self._lease_s = asdict(beat), lease_s
        self._alive, self._is_stopped = HeartbeatFile(alive), is_stopped
        self._changed, self._over = threading.Event(), threading.Event()
        self._away = False
        self.interval_s = min(BEAT_S, lease_s / 3)
        """Time between two signs of life [s]."""
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def update(self, **facts: str | float) -> None:
        """Facts that changed, such as the state, the name of the device, or how far the task is."""
        self._facts.update(facts)
        self._changed.set()

    def stop(self) -> None:
        """End the registration, and say that this worker is not lost. Nothing is said of one that never began."""
        if self._thread.ident is None:
            return
        self._over.set()
        self._changed.set()
        self._thread.join(2 * _ANSWER_S)
        try:
            left = Event(kind=EventKind.LEFT, at=timestamp(), worker=self._facts["name"])
            unlist_worker(self._connection, left)
        except (RedisError, OSError) as error:
            log.warning("Redis was away when the worker left: %s", error)
        self._connection.close()

    def _run(self) -> None:
        while not self._over.is_set():
            self._changed.clear()
            if not self._is_stopped():
                self._send()
                self._alive.touch()
            self._over.wait(_SHORTEST_INTERVAL_S)
            self._changed.wait(self.interval_s - _SHORTEST_INTERVAL_S)

    def _send(self) -> None:
        away, self._away = self._away, True
        try:
            list_worker(self._connection, self._facts | {"seen": timestamp()}, self._lease_s)
            self._away = False
        except (RedisError, OSError) as error:
            if not away:
                log.warning("no sign of life could be given: %s", error)
