"""Installed libraries: their versions, each looked up once, and imports without the garbage collector.

A room's modules are half a million objects. Each collection while they come looks at all that are there already, and so
does each full one afterwards, the last of them when the process ends: half of what a start and an end take.
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
    """The version of an installed distribution.

    Its folder is named after it; to ask `importlib.metadata` is to load it, which takes longer than a hand.

    Raises:
        importlib.metadata.PackageNotFoundError: it is not installed.
    """
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
    """Names, as folders write them, and versions of the distributions in a place of `sys.path`."""
    try:
        names = [found.name for found in Path(place or ".").iterdir()]
    except OSError:
        return []
    folders = [name.removesuffix(".dist-info") for name in names if name.endswith(".dist-info")]
    parts = [folder.rpartition("-") for folder in folders]
    return [(re.sub(r"[-_.]+", "_", name).lower(), version) for name, _, version in parts]


_ours = False


def own_process() -> None:
    """This process is graspd's own: what was imported stays until it ends, and collections leave it out.

    In somebody else's process their garbage would stay as well.
    """
    global _ours
    _ours = True


@contextmanager
def imports() -> Iterator[None]:
    """Import in here."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if _ours:
            gc.freeze()
        if collects:
            gc.enable()
