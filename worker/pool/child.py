"""Process of a `worker.pool.pool.Pool`: `python -m graspd.worker.pool.child [MODULE ...] FD`.

The process takes work from the socket with this file descriptor until the peer closes it. Data shared by several work
items are cached by key; the pool names the keys to evict. The modules are imported before the first item."""

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

from graspd.service.model.libraries import freeze_imports, pause_garbage_collection


@dataclass(frozen=True)
class WorkItem:
    """Work item: `work(shared, part)`."""

    work: Callable[[Any, Any], Any]
    key: str  # key of the data shared with other items
    shared: bytes | None  # pickled shared data; None if sent before
    forget: tuple[str, ...]
    part: Any


def serve(connection: Connection, modules: Sequence[str]) -> None:
    """Process requests one by one, once the modules are imported."""
    orders: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def read() -> None:
        try:
            while True:
                orders.put(connection.recv_bytes())
        except (EOFError, OSError):
            os._exit(0)  # no caller waits for the current item

    # Imports and work may take seconds: a separate thread detects that the peer is gone.
    threading.Thread(target=read, daemon=True).start()
    freeze_imports()
    with pause_garbage_collection():
        for name in modules:
            import_module(name)
    kept: dict[str, Any] = {}
    while True:
        answer = _process_order(orders.get(), kept)
        try:
            connection.send_bytes(answer)
        except OSError:
            os._exit(0)


def _process_order(order: bytes, kept: dict[str, Any]) -> bytes:
    try:
        wanted: WorkItem = pickle.loads(order)
        for key in wanted.forget:
            kept.pop(key, None)
        if wanted.shared is not None:
            kept[wanted.key] = pickle.loads(wanted.shared)
        return pickle.dumps((True, wanted.work(kept[wanted.key], wanted.part)))
    except Exception as error:
        return pickle.dumps((False, _to_picklable(error)))


def _to_picklable(error: Exception) -> Exception:
    """Return the error in a form that the peer can unpickle, with its traceback."""
    error.add_note("in a pool process: " + "".join(traceback.format_tb(error.__traceback__)))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


if __name__ == "__main__":
    # The module is imported by its full name, since pickles refer to this name and not to `__main__`.
    import_module("graspd.worker.pool.child").serve(Connection(int(sys.argv[-1])), sys.argv[1:-1])
