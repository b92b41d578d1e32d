"""The worker's side of its signs of life: what it is at, for `worker.process.pulse`, and what comes back from there."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from service.model.worker_beat import WorkerBeat
from service.queue.rq_keys import execution_keys
from service.queue.rq_queue import WORKERS, cancel_key, worker_key
from service.queue.streams import EVENTS, EVENTS_KEPT
from worker.stages.context import StopReason, TaskContext

log = logging.getLogger(__name__)
_RESTART_PAUSE_S: Final = 0.5
#: What leaving may take [s]: a round trip to Redis.
_LEAVE_S: Final = 3.0


@dataclass
class Hold:
    """A task in hand: its lease in Redis and the context to stop it by."""

    task_id: str
    context: TaskContext
    entry: str
    """Of the lease in its registry."""
    registry: str
    timeout_s: float

    @classmethod
    def of(cls, task_id: str, context: TaskContext, execution: Any, registry: Any, timeout_s: float) -> Hold:
        """The hold on an execution of RQ."""
        return cls(task_id, context, execution.composite_key, registry.key, timeout_s)

    def told(self) -> dict[str, Any]:
        """What the pulse needs to keep the lease, and to see to it that the task ends."""
        return {
            "entry": self.entry,
            "registry": self.registry,
            "cancel": cancel_key(self.task_id),
            "kept": execution_keys(self.entry),
            "seconds": self.timeout_s,
        }


class Heartbeat:
    """Keeps a worker's registration and the lease of its task alive, and listens for cancellation."""

    def __init__(self, url: str, beat: WorkerBeat, *, lease_s: float, alive: Path | None = None) -> None:
        """`url` is that of Redis; `alive` a file that is touched with each beat."""
        self._beat = asdict(beat)
        self._place = place_of(beat.name, lease_s) | {"url": url, "alive": str(alive or "")}
        self._hold: Hold | None = None
        self._limit: dict[str, Any] | None = None
        self._lock = threading.RLock()
        self._pending = False
        self._unsent = b""
        """Rest of a line that the pulse did not take whole."""
        self._stopping = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def start(self) -> None:
        self._spawn()
        self._thread.start()

    def stop(self) -> None:
        """End the pulse and the registration, and say that this worker is not lost."""
        self._stopping.set()
        deadline = time.monotonic() + _LEAVE_S
        while not self._write({"beat": self._beat, "leave": True}) and time.monotonic() < deadline:
            time.sleep(0.02)
        with self._lock:
            process, self._process = self._process, None
        if process is not None and process.stdin is not None:
            process.stdin.close()
            try:
                process.wait(timeout=max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._thread.join(timeout=1.0)

    @property
    def pid(self) -> int | None:
        """Of the pulse."""
        return self._process.pid if self._process is not None else None

    def hold(self, hold: Hold | None, *, state: str | None = None) -> None:
        """The task in hand from now on; None: there is none."""
        with self._lock:
            self._hold = hold
            self.update(task_id=hold.task_id if hold else "", state=state or ("busy" if hold else "idle"))

    def limit(self, what: str, seconds: float) -> None:
        """Something besides a task that must end within a time, or else the worker is ended."""
        with self._lock:
            self._limit = {"id": what, "seconds": seconds} if what else None
            self._tell()

    def stopping(self) -> None:
        """The worker takes no further task."""
        self.update(state="stopping")

    def update(self, **facts: str) -> None:
        """Facts that changed, such as the state, or the name of the device."""
        with self._lock:
            self._beat.update(facts)
            self._tell()

    def _tell(self) -> None:
        now_at = {"beat": self._beat, "limit": self._limit, "hold": self._hold and self._hold.told()}
        # A pulse that is not there yet, or busy, gets the news after its next beat.
        self._pending = not self._write(now_at)

    def _write(self, line: dict[str, Any]) -> bool:
        """Whether the pulse has the whole line; it never waits. What it lacks is sent before anything else."""
        with self._lock:
            if self._process is None or self._process.stdin is None:
                return True
            if not self._flush():
                return False
            self._unsent = json.dumps(line).encode() + b"\n"
            return self._flush()

    def _flush(self) -> bool:
        """Whether nothing is left unsent."""
        assert self._process is not None and self._process.stdin is not None
        try:
            while self._unsent:
                self._unsent = self._unsent[os.write(self._process.stdin.fileno(), self._unsent) :]
        except BlockingIOError:
            return False
        except (OSError, ValueError):  # it ended; the next one is told
            self._unsent = b""
        return True

    def _spawn(self) -> None:
        with self._lock:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "worker.process.pulse", str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,
            )
            assert self._process.stdin is not None
            os.set_blocking(self._process.stdin.fileno(), False)
            self._unsent = b""
            self._write(self._place)
            self._tell()

    def _run(self) -> None:
        """Listen; start the pulse again should it end (killed for memory, say)."""
        while not self._stopping.is_set():
            process = self._process
            if process is not None and process.stdout is not None:
                with process.stdout:
                    for line in process.stdout:
                        self._hear(line.decode(errors="replace").rstrip("\n"))
                if self._stopping.is_set():
                    return
                if process.stdin is not None:
                    process.stdin.close()
                log.warning("the signs of life stopped (exit code %s); they are started again", process.wait())
            self._stopping.wait(_RESTART_PAUSE_S)
            try:
                if not self._stopping.is_set():
                    self._spawn()
            except OSError as error:
                self._process = None
                log.warning("the signs of life cannot be started: %s", error)

    def _hear(self, line: str) -> None:
        word, _, about = line.partition("\t")
        with self._lock:
            if word == "." and (self._pending or self._unsent):
                self._tell()
            elif word in set(StopReason) and (hold := self._hold) is not None and hold.entry == about:
                hold.context.stop(StopReason(word))


def place_of(name: str, lease_s: float) -> dict[str, Any]:
    """What the pulse of a worker must know of the queue's keys."""
    return {
        "worker": worker_key(name),
        "workers": WORKERS,
        "events": EVENTS,
        "events_kept": EVENTS_KEPT,
        "lease_s": lease_s,
    }
