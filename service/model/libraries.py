"""Installed libraries: cached versions, and imports without garbage collection.

The modules of one process contain half a million Python objects. Garbage collections during imports and at exit would
scan all of them; this takes half of the time of start and exit.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.metadata import version

version_of = lru_cache(maxsize=64)(version)

_ours = False


def mark_process() -> None:
    """Mark this process as graspd's own: imported objects stay until exit, without garbage collection."""
    global _ours
    _ours = True


@contextmanager
def pause_garbage_collection() -> Iterator[None]:
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if _ours:
            gc.freeze()
        if collects:
            gc.enable()
