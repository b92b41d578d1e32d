"""Work for several processes of this machine, each with a core of its own; see `worker.pool.child` for the other side.

Threads share Python's lock: what holds it for a tenth of its time does not fill 16 cores. Processes are fresh ones and
not forks: a CUDA context and the threads of an engine outlive no fork. They end with the process that started them,
however it ends, for their socket closes with it.
"""

from __future__ import annotations

import logging
import os
import pickle
import subprocess
import sys
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Final

from service.model.errors import GraspdError, TaskCancelled
from worker.pool.child import Order

log = logging.getLogger(__name__)
#: What each process keeps of things that pieces of work share: two for a pair that is judged and measured.
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
class _Asked:
    """What one caller waits for."""

    work: Callable[[Any, Any], Any]
    key: str
    shared: Any
    results: list[Any]
    done: Callable[[int], None]
    left: int
    error: Exception | None = None
    dropped_at: float | None = None
    """When it was given up."""
    ended: threading.Event = field(default_factory=threading.Event)

    @cached_property
    def pickled(self) -> bytes:
        return pickle.dumps(self.shared)


@dataclass(frozen=True, eq=False)
class _Piece:
    asked: _Asked
    number: int
    part: Any


class Pool:
    """So many processes, started when they are first needed. Any thread may ask for work; a context manager."""

    def __init__(self, processes: int, modules: Sequence[str] = ()) -> None:
        """`modules` are imported by each process while it waits for its first piece of work."""
        self.processes, self._modules = processes, tuple(modules)
        self._changed = threading.Condition()
        self._waiting: deque[_Piece] = deque()
        self._places: list[_Place] = []
        self._closed = False

    def __enter__(self) -> Pool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def pids(self) -> list[int]:
        """Of the processes that run."""
        return [place.process.pid for place in self._places if place.process is not None]

    def start(self) -> None:
        """Begin to start the processes, if that was not done."""
        with self._changed:
            while not self._closed and len(self._places) < self.processes:
                place = _Place(self._modules)
                self._places.append(place)
                threading.Thread(target=self._serve, args=(place,), name="pool", daemon=True).start()

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
            Exception: what the first part to fail raised; the others are given up.
        """
        if not parts:
            return []
        self.start()
        asked = _Asked(work, key, shared, [None] * len(parts), done, len(parts))
        with self._changed:
            self._waiting.extend(_Piece(asked, number, part) for number, part in enumerate(parts))
            self._changed.notify_all()
        while not asked.ended.wait(_LOOK_S):
            if cancelled() or self._closed:
                self._drop(asked)
                raise TaskCancelled("stopped while other processes worked for it")
        if asked.error is not None:
            self._drop(asked)
            raise asked.error
        return asked.results

    def close(self) -> None:
        """End all processes; who waits for work is told that it was cancelled."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for place in self._places:
            place.end()

    def _drop(self, asked: _Asked) -> None:
        with self._changed:
            asked.dropped_at = time.monotonic()
            self._waiting = deque(piece for piece in self._waiting if piece.asked is not asked)

    def _serve(self, place: _Place) -> None:
        with suppress(OSError):  # it is told to whoever needs the process
            place.start()
        while True:
            with self._changed:
                while not self._closed and not self._waiting:
                    self._changed.wait()
                if self._closed:
                    break
                piece = self._waiting.popleft()
            try:
                self._end(piece, place.do(piece))
            except Exception as error:
                self._fail(piece.asked, error)
        place.end()

    def _end(self, piece: _Piece, result: Any) -> None:
        asked = piece.asked
        if asked.dropped_at is None:
            asked.done(piece.number)
        with self._changed:
            asked.results[piece.number] = result
            asked.left -= 1
            if not asked.left:
                asked.ended.set()

    def _fail(self, asked: _Asked, error: Exception) -> None:
        with self._changed:
            asked.error = asked.error or error
            asked.ended.set()


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
        self._connection, theirs = Pipe()
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "worker.pool.child", str(theirs.fileno()), *self._modules],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                env={**os.environ, **_NO_GPU},
                start_new_session=True,  # Ctrl-C in the terminal is for the parent alone
            )

    def do(self, piece: _Piece) -> Any:
        """The result of a piece of work; raises ProcessLost, or what the work raised."""
        try:
            if self._is_gone():
                self._stop()
                self.start()
            assert self._connection is not None
            self._connection.send_bytes(pickle.dumps(self._order(piece)))
            while not self._connection.poll(_LOOK_S):
                if (since := piece.asked.dropped_at) is not None and time.monotonic() - since > _PATIENCE_S:
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

    def _order(self, piece: _Piece) -> Order:
        asked, forget = piece.asked, list[str]()
        known = asked.key in self._kept
        self._kept[asked.key] = None
        self._kept.move_to_end(asked.key)
        while len(self._kept) > KEPT:
            forget.append(self._kept.popitem(last=False)[0])
        return Order(asked.work, asked.key, None if known else asked.pickled, tuple(forget), piece.part)

    def _stop(self) -> str:
        """End the process if it runs; how it ended."""
        process, self.process = self.process, None
        if self._connection is not None:
            self._connection.close()
        if process is None:
            return "it could not be started"
        with suppress(subprocess.TimeoutExpired):
            process.wait(_LOOK_S)
        process.kill()
        code = process.wait()
        return f"signal {-code}" if code < 0 else f"exit code {code}"

    def end(self) -> None:
        """Kill the process, if there is one: it holds nothing that could be lost."""
        if (process := self.process) is not None:
            process.kill()
            process.wait()
