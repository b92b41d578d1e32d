"""Prepared objects on this machine: what one command has prepared, every later one reads in milliseconds."""

from __future__ import annotations

import hashlib
import platform
import zipfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Final

from service import user_cache
from service.model.digests import digest_json
from service.model.libraries import version_of
from worker.objects.model import ObjectModel
from worker.objects.packed import from_bytes, to_bytes

#: Libraries whose results go into a prepared object.
_LIBRARIES: Final = ("numpy", "scipy", "manifold3d", "fast-simplification")


def kept_or_made(terms: tuple[str, ...], data: bytes, make: Callable[[], ObjectModel]) -> ObjectModel:
    """A prepared object from the user's cache, else made and kept there.

    Args:
        terms: all that the object follows from, besides the bytes of its mesh and the code that prepares it.
        data: the mesh as it was given.
        make: prepares it; what it raises is not kept.
    """
    address = digest_json([*terms, hashlib.sha256(data).hexdigest(), revision()])
    file = user_cache.folder("objects") / f"{address}.npz"
    if (held := user_cache.load(file)) is not None:
        try:
            return from_bytes(held, name="", digest="")
        except (ValueError, KeyError, TypeError, OSError, EOFError, zipfile.BadZipFile):
            pass
    obj = make()
    user_cache.keep(file, to_bytes(obj))
    return obj


@lru_cache(maxsize=1)
def revision() -> str:
    """Digest of what prepares: this package's source, its libraries, and the kind of processor, whose last bits may
    differ. So a change to how objects are prepared leaves no old one in use, and nobody has to remember a number."""
    whole = hashlib.sha256()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        whole.update(file.read_bytes())
    return digest_json([whole.hexdigest(), *map(version_of, _LIBRARIES), platform.machine()])
