"""Installed libraries: cached versions, and imports without garbage collection.

The modules of one process contain half a million objects. Garbage collections during imports, and full collections
later and at exit, scan all of them. This takes half of the time of start and exit.
"""

from __future__ import annotations

import gc
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path


@lru_cache(maxsize=64)
def version_of(library: str) -> str:
    """Return the version of an installed distribution, from its folder's name: `importlib.metadata` is slow."""
    wanted = re.sub(r"[-_.]+", "_", library).lower()
    for place in sys.path:
        found = [version for name, version in _distributions(place) if name == wanted]
        if len(found) == 1:
            return found[0]
        if found:
            break
    from importlib.metadata import version

    return version(library)


@lru_cache(maxsize=16)
def _distributions(place: str) -> list[tuple[str, str]]:
    try:
        names = [found.name for found in Path(place or ".").iterdir()]
    except OSError:
        return []
    folders = [name.removesuffix(".dist-info") for name in names if name.endswith(".dist-info")]
    parts = [folder.rpartition("-") for folder in folders]
    return [(re.sub(r"[-_.]+", "_", name).lower(), version) for name, _, version in parts]


_ours = False


def own_process() -> None:
    """Mark this process as graspd's own: garbage collection excludes imported objects, which stay until exit."""
    global _ours
    _ours = True


@contextmanager
def imports() -> Iterator[None]:
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if _ours:
            gc.freeze()
        if collects:
            gc.enable()
