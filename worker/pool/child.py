"""A process of a `worker.pool.pool.Pool`: `python -m graspd.worker.pool.child [MODULE ...] FD`.

It takes work from the socket with that file descriptor until the other side is gone. What several pieces of work share
is kept by its key; the pool tells which of it to forget. The modules are imported before the first piece comes.
"""

from __future__ import annotations

import os
import pickle
import queue
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.connection import Connection
from typing import Any

from graspd.service.model.libraries import imports, own_process


@dataclass(frozen=True)
class WorkItem:
    """A piece of work: `work(shared, part)`."""

    work: Callable[[Any, Any], Any]
    key: str
    """Of what is shared with other pieces."""
    shared: bytes | None
    """It, pickled; None: it was sent before."""
    forget: tuple[str, ...]
    """Keys that are not needed any more."""
    part: Any


def serve(connection: Connection, modules: Sequence[str]) -> None:
    """Do what is asked for, one piece after the other, once the modules are imported."""
    orders: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def read() -> None:
        try:
            while True:
                orders.put(connection.recv_bytes())
        except (EOFError, OSError):
            os._exit(0)  # nobody waits for what is being done

    # Imports and work may take seconds: whether somebody still wants them is told by a thread of its own.
    threading.Thread(target=read, daemon=True).start()
    own_process()
    with imports():
        for name in modules:
            import_module(name)
    kept: dict[str, Any] = {}
    while True:
        answer = _answer(orders.get(), kept)
        try:
            connection.send_bytes(answer)
        except OSError:
            os._exit(0)


def _answer(order: bytes, kept: dict[str, Any]) -> bytes:
    """Pickled: whether it was done, and the result or the error."""
    try:
        wanted: WorkItem = pickle.loads(order)
        for key in wanted.forget:
            kept.pop(key, None)
        if wanted.shared is not None:
            kept[wanted.key] = pickle.loads(wanted.shared)
        return pickle.dumps((True, wanted.work(kept[wanted.key], wanted.part)))
    except Exception as error:
        return pickle.dumps((False, _portable(error)))


def _portable(error: Exception) -> Exception:
    """The error as the other side can read it, with where it came up."""
    error.add_note("in a process beside: " + "".join(traceback.format_tb(error.__traceback__)))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


if __name__ == "__main__":
    # By its full name: what is pickled names its module, and `__main__` is another one.
    import_module("graspd.worker.pool.child").serve(Connection(int(sys.argv[-1])), sys.argv[1:-1])
