"""Work for several processes of this machine, each with a core of its own; see `worker.pool.child` for the other side.

Threads share Python's lock: what holds it for a tenth of its time does not fill 16 cores. Processes are fresh ones and
not forks: a CUDA context and the threads of an engine outlive no fork. They end with the process that started them,
however it ends, for their pipe closes with it. The library's `ProcessPoolExecutor` would import the program of whoever
calls `graspd.synthesize` once more in each of them.
"""

from __future__ import annotations

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
#: Modules whose work the processes do for a worker; named and not imported: a worker is there before its engine is.
MODULES: Final = ("graspd.worker.validation.validator", "graspd.worker.quality.table")
#: What each process keeps of things that pieces of work share: two for a pair that is validated and measured.
KEPT: Final = 8
#: Pause between two looks at whether to stop [s].
_LOOK_S: Final = 0.1
#: A process that goes on for so long with what nobody wants any more is ended [s].
_PATIENCE_S: Final = 20.0
#: No process takes memory of a GPU: what it does is for the CPU.
_NO_GPU: Final = {"CUDA_VISIBLE_DEVICES": ""}


class ProcessLost(GraspdError):
    """A process of a pool ended in the middle of its work; a fresh one has taken its place."""

    slug, title = "process-lost", "A process beside the worker ended in the middle of its work"


@dataclass(eq=False)
class _Request:
    """What one caller waits for."""

    work: Callable[[Any, Any], Any]
    key: str
    shared: Any
    done: Callable[[int], None]
    dropped_at: float | None = None
    """When nobody waited for it any more."""

    @cached_property
    def pickled(self) -> bytes:
        return pickle.dumps(self.shared)


class Pool(AbstractContextManager["Pool"]):
    """So many processes, started when they are first needed. Any thread may ask for work; a context manager."""

    def __init__(self, processes: int, modules: Sequence[str] = ()) -> None:
        """`modules` are imported by each process while it waits for its first piece of work."""
        self.processes = processes
        self._places = [_Place(modules) for _ in range(processes)]
        self._idle: queue.SimpleQueue[_Place] = queue.SimpleQueue()
        self._threads = ThreadPoolExecutor(processes, thread_name_prefix="pool")
        self._changing = threading.Lock()
        self._started = self._closed = False

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pids(self) -> list[int]:
        """Of the processes that run."""
        return [place.process.pid for place in self._places if place.process is not None]

    def start(self) -> None:
        """Start the processes, if that was not done."""
        with self._changing:
            for place in self._places if not (self._started or self._closed) else ():
                with suppress(OSError):  # it is told to whoever needs the process
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
        """The results of `work(shared, part)` for all parts, in their order.

        Args:
            work: a function that a process can import, without effects but its result.
            key: the same for what is the same as `shared`, so that a process gets it once.
            shared: what all parts need; it is pickled.
            parts: each is done by one process; the first of those who ask are served first.
            cancelled: asked often. True: nothing more is done.
            done: told the number of each part that is done, by another thread.

        Raises:
            ProcessLost: a process ended over a part.
            TaskCancelled: `cancelled` answered True, or the pool was closed.
            Exception: what a part raised; the others are given up.
        """
        self.start()
        request = _Request(work, key, shared, done)
        with self._changing:
            wanted = () if self._closed else enumerate(parts)
            futures = [self._threads.submit(self._do, request, number, part) for number, part in wanted]
        try:
            while True:
                _, left = wait(futures, _LOOK_S, FIRST_EXCEPTION)
                if self._closed or (left and cancelled()):
                    raise TaskCancelled("stopped while other processes worked for it")
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
        """End all processes; who waits for work is told that it was cancelled."""
        with self._changing:
            self._closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        for place in self._places:
            place.end()

    def _do(self, request: _Request, number: int, part: Any) -> Any:
        place = self._idle.get()
        try:
            made = place.do(request, part)
        finally:
            self._idle.put(place)
            if self._closed:
                place.end()
        if request.dropped_at is None:
            request.done(number)
        return made


class _Place:
    """Of one process at a time, and of what it keeps. `end` may be called by another thread."""

    def __init__(self, modules: Sequence[str]) -> None:
        self._modules = tuple(modules)
        self.process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._kept: OrderedDict[str, None] = OrderedDict()

    def start(self) -> None:
        """A fresh process. Raises OSError."""
        self._kept.clear()
        self._connection, self.process = start_child(
            [sys.executable, "-m", "graspd.worker.pool.child", *self._modules],
            stdout=subprocess.DEVNULL,
            env={**os.environ, **_NO_GPU},
        )

    def do(self, request: _Request, part: Any) -> Any:
        """The result of a piece of work; raises ProcessLost, or what the work raised."""
        try:
            if self._is_gone():
                self._stop()
                self.start()
            assert self._connection is not None
            self._connection.send_bytes(pickle.dumps(self._order(request, part)))
            while not self._connection.poll(_LOOK_S):
                if (since := request.dropped_at) is not None and time.monotonic() - since > _PATIENCE_S:
                    log.warning("a process does not end what was given up; it is killed")
                    self._stop()
                    raise TaskCancelled("stopped")
            succeeded, made = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError) as error:
            raise ProcessLost(
                f"a process beside the worker ended in the middle of its work ({self._stop()})"
            ) from error
        if not succeeded:
            raise made
        return made

    def _is_gone(self) -> bool:
        """Whether there is no process, or it ended while it waited: one that waits sends nothing but the end of its
        connection, which is there before the system tells that it ended."""
        if self.process is None or self._connection is None or self.process.poll() is not None:
            return True
        return self._connection.poll()

    def _order(self, request: _Request, part: Any) -> WorkItem:
        forget = list[str]()
        known = request.key in self._kept
        self._kept[request.key] = None
        self._kept.move_to_end(request.key)
        while len(self._kept) > KEPT:
            forget.append(self._kept.popitem(last=False)[0])
        return WorkItem(request.work, request.key, None if known else request.pickled, tuple(forget), part)

    def _stop(self) -> str:
        """End the process if it runs; how it ended."""
        process, self.process = self.process, None
        if self._connection is not None:
            self._connection.close()
        return "it could not be started" if process is None else end_child(process, _LOOK_S)

    def end(self) -> None:
        """Kill the process, if there is one: it holds nothing that could be lost."""
        if (process := self.process) is not None:
            end_child(process, 0.0)


def start_child(command: Sequence[str], **options: Any) -> tuple[Connection, subprocess.Popen[bytes]]:
    """A fresh process and a pipe to it, whose other end is the last argument of its command line. Raises OSError."""
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
    """How a process ended; one that has not after so long is killed [s]."""
    with suppress(subprocess.TimeoutExpired):
        process.wait(patience_s)
    process.kill()
    code = process.wait()
    return f"signal {-code}" if code < 0 else f"exit code {code}"
