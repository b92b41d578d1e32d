"""Registration of a worker: heartbeats with its state."""

import logging
import threading
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from redis.exceptions import RedisError

from graspd.service.model.clock import timestamp
from graspd.service.model.messages import WorkerHeartbeat
from graspd.service.queue.connection import connect
from graspd.service.queue.port import Event, EventKind
from graspd.service.queue.rq_queue import register_worker, unregister_worker
from graspd.service.telemetry import HeartbeatFile

log = logging.getLogger(__name__)
BEAT_S: Final = 0.8  # longest interval of heartbeats and of checks for cancellation, which must take effect in 2 s [s]
_SHORTEST_INTERVAL_S: Final = 0.1  # least interval between two updates [s]
_ANSWER_S: Final = 3.0  # longest wait for a response of Redis [s]


class Heartbeat:
    """Sends heartbeats from its own thread and connection, which stay free while the worker waits."""

    def __init__(
        self,
        url: str,
        beat: WorkerHeartbeat,
        *,
        lease_s: float,
        alive: Path | None = None,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """`lease_s` [s] is the registration's lifetime after a heartbeat; each one touches the file `alive`.
        No heartbeat is sent while `is_stopped` returns True: the worker hangs, although this thread runs."""
        self._connection: Any = connect(url, patience=0, timeout_s=_ANSWER_S)
        self._facts, self._lease_s = asdict(beat), lease_s
        self._alive, self._is_stopped = HeartbeatFile(alive), is_stopped
        self._changed, self._over = threading.Event(), threading.Event()
        self._away = False
        self.interval_s = min(BEAT_S, lease_s / 3)  # interval of heartbeats [s]
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def update(self, **facts: str | float) -> None:
        self._facts.update(facts)
        self._changed.set()

    def stop(self) -> None:
        """End the registration and record a regular end; before `start`, do nothing."""
        if self._thread.ident is None:
            return
        self._over.set()
        self._changed.set()
        self._thread.join(2 * _ANSWER_S)
        try:
            left = Event(kind=EventKind.LEFT, at=timestamp(), worker=self._facts["name"])
            unregister_worker(self._connection, left)
        except (RedisError, OSError) as error:
            log.warning("Redis was unavailable when the worker ended: %s", error)
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
            register_worker(self._connection, self._facts | {"seen": timestamp()}, self._lease_s)
            self._away = False
        except (RedisError, OSError) as error:
            if not away:
                log.warning("no heartbeat could be sent: %s", error)
