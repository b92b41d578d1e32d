"""Where compiled kernels are kept: where Warp would, or where this user can write."""

from __future__ import annotations

import logging
import os
from pathlib import Path

from service import user_cache

log = logging.getLogger(__name__)


def kernel_cache() -> Path | None:
    """Folder to tell Warp of; None where its own choice (`$WARP_CACHE_PATH`, or the home folder) can be written.

    Containers run as any user, and on a root file system that may be read-only.
    """
    named = os.environ.get("WARP_CACHE_PATH", "")
    cache = os.environ.get("XDG_CACHE_HOME") or Path(os.environ.get("HOME") or "/") / ".cache"
    wanted = Path(named) if named else Path(cache) / "warp"
    try:
        wanted.mkdir(parents=True, exist_ok=True)
        if os.access(wanted, os.W_OK | os.X_OK):
            return None
        trouble = "it cannot be written"
    except OSError as error:
        trouble = error.strerror or str(error)
    folder = user_cache.folder("warp")
    log.warning("no kernels can be kept in %s (%s); they are kept in %s", wanted, trouble, folder)
    return folder
