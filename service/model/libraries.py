"""Versions of installed libraries, each looked up once by a process."""

from __future__ import annotations

import re
import sys
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
