"""Arrays on this machine that take long to compute and follow from little: read in a millisecond by later processes."""

from __future__ import annotations

import hashlib
import io
import platform
import zipfile
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service import user_cache
from service.model.digests import digest_json

#: Libraries that go into the arrays.
_LIBRARIES: Final = ("numpy", "scipy")
#: All entries of a kind together; one has some 100 kB.
_LIMIT_BYTES: Final = 256 << 20

Arrays = Mapping[str, NDArray[Any]]


def arrays_kept_or_made(
    kind: str, terms: tuple[str | int, ...], code: tuple[ModuleType, ...], make: Callable[[], Arrays]
) -> Arrays:
    """Arrays from the user's cache, else made and kept there; the same bit for bit.

    Args:
        kind: folder of the cache.
        terms: all that they follow from, besides the code.
        code: modules whose change would change them.
        make: computes them; what it raises is not kept.
    """
    address = digest_json([*terms, _revision(tuple(str(module.__file__) for module in code))])
    file = user_cache.folder(kind) / f"{address}.npz"
    if (held := user_cache.load(file)) is not None:
        try:
            with np.load(io.BytesIO(held), allow_pickle=False) as stored:
                return {name: stored[name] for name in stored.files}
        except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile):
            pass
    made = make()
    whole = io.BytesIO()
    np.savez(whole, **dict[str, Any](made))
    user_cache.keep(file, whole.getvalue(), limit_bytes=_LIMIT_BYTES)
    return made


@lru_cache(maxsize=16)
def _revision(files: tuple[str, ...]) -> str:
    """Digest of source files, of libraries, and of the kind of processor, whose last bits may differ."""
    whole = hashlib.sha256()
    for file in files:
        whole.update(Path(file).read_bytes())
    return digest_json([whole.hexdigest(), *map(version, _LIBRARIES), platform.machine()])
