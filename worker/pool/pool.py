"""Pool of processes on this machine, one core each; `worker.pool.child` is the process itself.

Threads share Python's lock: work that holds it for a tenth of its time does not fill 16 cores. Processes start fresh,
since CUDA contexts and threads do not survive a fork; they end with the parent. Python's `ProcessPoolExecutor` would
import the program that calls `graspd.synthesize` once more in each process."""

import logging
import os
import pickle
import queue
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import cached_property
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, Final

from graspd.service.model.errors import GraspdError, TaskCancelled
from graspd.worker.pool.child import WorkItem

log = logging.getLogger(__name__)
#: Modules for the work of a worker; not imported here, so that a worker starts before its engine.
MODULES: Final = ("graspd.worker.validation.validator", "graspd.worker.quality.table")
KEPT: Final = 8  # number of shared inputs cached per process: two for a pair that is validated and measured
_LOOK_S: Final = 0.1  # interval of checks for a stop [s]
_PATIENCE_S: Final = 20.0  # time after which a process that still works on an abandoned item is ended [s]
_NO_GPU: Final = {"CUDA_VISIBLE_DEVICES": ""}  # processes compute on the CPU and take no GPU memory


class ProcessLost(GraspdError):
    """A process of the pool ended during an item; the next item gets a fresh one."""

    slug, title = "process-lost", "A process of the pool ended during its work"


@dataclass(eq=False)
class _Request:
    work: Callable[[Any, Any], Any]
    key: str
    shared: Any
    done: Callable[[int], None]
    dropped_at: float | None = None  # time at which the caller stopped waiting

    @cached_property
    def pickled(self) -> bytes:
        return pickle.dumps(self.shared)


class Pool(AbstractContextManager["Pool"]):
    """Processes started at first use. Thread-safe; a context manager."""

    def __init__(self, processes: int, modules: Sequence[str] = ()) -> None:
        """`modules` are imported by each process before its first item."""
        self.processes = processes
        self._places = [_Slot(modules) for _ in range(processes)]
        self._idle: queue.SimpleQueue[_Slot] = queue.SimpleQueue()
        self._threads = ThreadPoolExecutor(processes, thread_name_prefix="pool")
        self._changing = threading.Lock()
        self._started = self._closed = False

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pids(self) -> list[int]:
        return [place.process.pid for place in self._places if place.process is not None]

    def start(self) -> None:
        with self._changing:
            for place in self._places if not (self._started or self._closed) else ():
                with suppress(OSError):  # reported on use of the process
                    place.start()
                self._idle.put(place)
            self._started = True

    def map(
        self,
        work: Callable[[Any, Any], Any],
        key: str,
        shared: Any,
        parts: Sequence[Any],
        *,
        cancelled: Callable[[], bool] = lambda: False,
        done: Callable[[int], None] = lambda number: None,
    ) -> list[Any]:
        """Return `work(shared, part)` for all parts in order; `work` is importable, without side effects.
        Each process receives the pickled `shared` once, under its `key`. `done` receives the number of each finished
        part, in another thread. An error of a part abandons the other parts. Raises ProcessLost: a process ended during
        a part. TaskCancelled: `cancelled` returned True, or the pool was closed."""
        self.start()
        request = _Request(work, key, shared, done)
        with self._changing:
            wanted = () if self._closed else enumerate(parts)
            futures = [self._threads.submit(self._run_part, request, number, part) for number, part in wanted]
        try:
            while True:
                _, left = wait(futures, _LOOK_S, FIRST_EXCEPTION)
                if self._closed or (left and cancelled()):
                    raise TaskCancelled("stopped during work in the process pool")
                for future in futures:
                    if future.done() and (error := future.exception()) is not None:
                        raise error
                if not left:
                    return [future.result() for future in futures]
        finally:
            request.dropped_at = time.monotonic()
            for future in futures:
                future.cancel()

    def close(self) -> None:
        """End all processes; waiting callers get TaskCancelled."""
        with self._changing:
            self._closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        for place in self._places:
            place.end()

    def _run_part(self, request: _Request, number: int, part: Any) -> Any:
        place = self._idle.get()
        try:
            made = place.run_item(request, part)
        finally:
            self._idle.put(place)
            if self._closed:
                place.end()
        if request.dropped_at is None:
            request.done(number)
        return made


class _Slot:
    """A place of the pool: one process at a time, and the keys in its cache. Any thread may call `end`."""

    def __init__(self, modules: Sequence[str]) -> None:
        self._modules = tuple(modules)
        self.process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._kept: OrderedDict[str, None] = OrderedDict()

    def start(self) -> None:
        """Start a fresh process. Raises OSError."""
        self._kept.clear()
        self._connection, self.process = start_child(
            [sys.executable, "-m", "graspd.worker.pool.child", *self._modules],
            stdout=subprocess.DEVNULL,
            env={**os.environ, **_NO_GPU},
        )

    def run_item(self, request: _Request, part: Any) -> Any:
        """Return the result of an item; raise ProcessLost, or the error of the item."""
        try:
            if self._is_gone():
                self._stop()
                self.start()
            assert self._connection is not None
            self._connection.send_bytes(pickle.dumps(self._work_item(request, part)))
            while not self._connection.poll(_LOOK_S):
                if (since := request.dropped_at) is not None and time.monotonic() - since > _PATIENCE_S:
                    log.warning("a process does not end an abandoned item; it is killed")
                    self._stop()
                    raise TaskCancelled("stopped")
            succeeded, made = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError) as error:
            raise ProcessLost(f"a process of the pool ended during its work ({self._stop()})") from error
        if not succeeded:
            raise made
        return made

    def _is_gone(self) -> bool:
        """Check whether there is no process, or it ended while idle.
        An idle process sends only the end of its connection, which arrives before the system reports its exit."""
        if self.process is None or self._connection is None or self.process.poll() is not None:
            return True
        return self._connection.poll()

    def _work_item(self, request: _Request, part: Any) -> WorkItem:
        forget = list[str]()
        known = request.key in self._kept
        self._kept[request.key] = None
        self._kept.move_to_end(request.key)
        while len(self._kept) > KEPT:
            forget.append(self._kept.popitem(last=False)[0])
        return WorkItem(request.work, request.key, None if known else request.pickled, tuple(forget), part)

    def _stop(self) -> str:
        """End the process if it runs; return how it ended."""
        process, self.process = self.process, None
        if self._connection is not None:
            self._connection.close()
        return "it could not be started" if process is None else end_child(process, _LOOK_S)

    def end(self) -> None:
        """Kill the process, if there is one: it has no state to save."""
        if (process := self.process) is not None:
            end_child(process, 0.0)


def start_child(command: Sequence[str], **options: Any) -> tuple[Connection, subprocess.Popen[bytes]]:
    """Start a process with a pipe, whose file descriptor becomes the last argument. Raises OSError."""
    ours, theirs = Pipe()
    with theirs:
        process = subprocess.Popen(
            [*command, str(theirs.fileno())],
            stdin=subprocess.DEVNULL,
            pass_fds=(theirs.fileno(),),
            start_new_session=True,  # Ctrl-C in the terminal is for the parent alone
            **options,
        )
    return ours, process


def end_child(process: subprocess.Popen[bytes], patience_s: float) -> str:
    """Wait for a process, kill it after `patience_s` [s], and return how it ended."""
    with suppress(subprocess.TimeoutExpired):
        process.wait(patience_s)
    process.kill()
    code = process.wait()
    return f"signal {-code}" if code < 0 else f"exit code {code}"
