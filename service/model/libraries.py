"""Installed libraries: cached versions, and imports without garbage collection.

Garbage collections scan half a million objects of imported modules, and take half of the time of start and exit.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.metadata import version

version_of = lru_cache(maxsize=64)(version)

_ours = False


def freeze_imports() -> None:
    """Exclude imported objects from garbage collection in this process, which must be graspd's own."""
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
