"""Worker's end of the pipe to its engine (`worker.process.engine`), and the messages on it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final, Literal

from graspd.service.model.states import Stage
from graspd.worker.pool.pool import end_child, start_child
from graspd.worker.stages.context import StopReason

if TYPE_CHECKING:
    from graspd.service.settings import Settings

_END_S: Final = 3.0  # time for an engine to end by itself [s]


class EngineLost(Exception):
    """The engine of a worker ended unexpectedly."""


@dataclass(frozen=True)
class Setup:
    """Configuration of an engine, sent before its first task."""

    settings: Settings
    stages: tuple[Stage, ...]
    worker: str
    patient: bool  # whether to wait in quarantine until the first check passes


class Link:
    """Connection of a worker to its engine, used by one thread."""

    def __init__(self, connection: Connection, process: subprocess.Popen[bytes] | None = None) -> None:
        """`process` is None if the engine has no process of its own."""
        self._connection, self._process = connection, process

    def send(self, word: str, about: Any = None) -> None:
        with suppress(OSError):
            self._connection.send((word, about))

    def receive(self, wait_s: float) -> tuple[str, Any] | None:
        """Receive a message; None after a timeout. Raises EngineLost."""
        try:
            return self._connection.recv() if self._connection.poll(wait_s) else None
        except (EOFError, OSError):
            raise EngineLost(f"the engine ended ({self._end_process()})") from None

    @property
    def is_stopped(self) -> bool:
        """Check whether the engine makes no progress: a signal such as SIGSTOP stopped it, or it ended."""
        return self._process is not None and is_stopped(self._process.pid)

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """End the engine, gracefully if it responds in time."""
        self.send("end", StopReason.SHUTDOWN)
        self._end_process()
        self._connection.close()

    def _end_process(self) -> str:
        return "its thread ended" if self._process is None else end_child(self._process, _END_S)


StartEngine = Callable[[Setup], Link]
#: State of an engine after a task: fit for the next one, unfit, or too large and due for replacement.
Condition = Literal["fit", "unfit", "outgrown"]


def start_engine(setup: Setup, program: Sequence[str] = (sys.executable, "-m", "graspd.worker.process.engine")) -> Link:
    """Start an engine in a fresh process, which ends with this one; CUDA contexts do not survive a fork.
    Call it from the main thread: the kernel ties a child to the thread that starts it."""
    ours, process = start_child([sys.executable, "-m", "graspd.service.run.launch", str(os.getpid()), *program])
    link = Link(ours, process)
    # Only the values are sent: the library that reads settings takes 8 MiB per process.
    values: Any = SimpleNamespace(**dict(setup.settings), resolved_store_url=setup.settings.resolved_store_url)
    ours.send(replace(setup, settings=values))
    return link


def is_stopped(pid: int) -> bool:
    """Check whether a process was stopped by a signal, or ended."""
    if sys.platform == "linux":
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (OSError, IndexError):
            return True
    else:
        listing = subprocess.run(["ps", "-o", "state=", "-p", str(pid)], capture_output=True, check=False, text=True)
        state = listing.stdout.strip()[:1]
    return state in ("T", "t", "Z", "X", "")
