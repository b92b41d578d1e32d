"""Signs of life from a thread of its own, so that a launch that takes minutes does not cost the lease.

Warp releases the interpreter lock while a kernel runs, so the thread keeps its time.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Final

from redis.exceptions import RedisError

from service.clock import timestamp
from service.queue.port import Event, EventKind, WorkerBeat
from service.queue.rq_queue import EVENTS, EVENTS_KEPT, WORKERS, cancel_key, encoded, worker_key
from worker.context import StopReason, TaskContext

log = logging.getLogger(__name__)
#: A cancelled task must stop within two seconds, so the key that says so is read twice in that time.
_LONGEST_INTERVAL_S: Final = 0.8
#: How long Redis keeps a lease without a beat [s]: much longer than the keeper, which watches beats, takes to act.
LEASE_KEPT_S: Final = 3600
#: Time a task has to notice that it must stop before its worker gives itself up [s].
STUCK_AFTER_S: Final = 60.0


@dataclass
class Hold:
    """A task in hand: its lease in Redis and the context to stop it by."""

    task_id: str
    context: TaskContext
    execution: Any
    registry: Any
    timeout_s: float
    started: float


class Heartbeat:
    """Keeps a worker's registration and the lease of its task alive, and listens for cancellation."""

    def __init__(
        self,
        connection: Any,
        beat: WorkerBeat,
        *,
        lease_s: float,
        give_up: Callable[[Hold], None] | None = None,
    ) -> None:
        self._connection = connection
        self._beat = asdict(beat)
        self._lease_s = lease_s
        self._interval_s = min(_LONGEST_INTERVAL_S, lease_s / 3)
        self._give_up = give_up or _exit
        self._hold: Hold | None = None
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the thread and the registration, and say that this worker is not lost."""
        self._stop.set()
        self._thread.join(timeout=5.0)
        try:
            with self._connection.pipeline() as pipe:
                pipe.delete(worker_key(self._beat["name"]))
                pipe.srem(WORKERS, self._beat["name"])
                left = Event(kind=EventKind.LEFT, at=timestamp(), worker=self._beat["name"])
                pipe.xadd(EVENTS, encoded(left), maxlen=EVENTS_KEPT, approximate=True)
                pipe.execute()
        except RedisError:
            log.debug("Redis was away when the worker left")

    def hold(self, hold: Hold | None, *, state: str | None = None) -> None:
        """The task in hand from now on, or None."""
        with self._lock:
            self._hold = hold
            self._beat["task_id"] = hold.task_id if hold else ""
            self._beat["state"] = state or ("busy" if hold else "idle")

    def stopping(self) -> None:
        """The worker takes no further task."""
        self._beat["state"] = "stopping"

    def update(self, **facts: str) -> None:
        """Facts that were not known at the start, such as the name of the device."""
        self._beat.update(facts)

    def _run(self) -> None:
        while not self._stop.is_set():
            with self._lock:
                hold = self._hold
            try:
                self._tick(hold)
            except RedisError as error:
                log.warning("no sign of life could be given: %s", error)
            except Exception:
                log.exception("the heartbeat goes on after an error")
            self._stop.wait(self._interval_s)

    def _tick(self, hold: Hold | None) -> None:
        if hold is not None:
            self._watch_time(hold)
        lease = max(2, round(self._lease_s))
        with self._connection.pipeline() as pipe:
            pipe.set(worker_key(self._beat["name"]), json.dumps(self._beat | {"seen": timestamp()}), ex=lease)
            pipe.sadd(WORKERS, self._beat["name"])
            if hold is not None:
                hold.execution.heartbeat(hold.registry, LEASE_KEPT_S, pipeline=pipe)
                pipe.zscore(hold.registry.key, hold.execution.composite_key)
                pipe.exists(cancel_key(hold.task_id))
            results = pipe.execute()
        if hold is not None:
            if results[-1]:
                hold.context.stop(StopReason.CANCELLED)
            elif results[-2] is None:
                hold.context.stop(StopReason.LEASE_LOST)

    def _watch_time(self, hold: Hold) -> None:
        running = time.monotonic() - hold.started
        if running > hold.timeout_s:
            hold.context.stop(StopReason.TIMEOUT)
        if running > hold.timeout_s + STUCK_AFTER_S:
            self._give_up(hold)


def _exit(hold: Hold) -> None:
    log.critical("task %s does not stop; the worker ends itself and the task is taken from it", hold.task_id)
    os._exit(70)
