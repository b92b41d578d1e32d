"""Warp, started quietly: on a machine without a GPU its C++ side says so on stderr at every start.

Compiled kernels are kept where Warp would, or where this user can write.
"""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import warp as wp

from service import user_cache
from worker.engines.baked import lay_out

_HARMLESS = b"Could not find or load the NVIDIA CUDA driver"
_lock = threading.Lock()
_started = False
log = logging.getLogger(__name__)


def _default_of_each_thread() -> None:
    """Let every thread have a default device of its own. Warp has one for all: a `ScopedDevice` of one thread would put
    the arrays that another makes meanwhile onto its device, and leave its own behind as the default. Until every
    array is made with its device named, this is the one place that touches Warp's internals."""
    from warp._src.context import Runtime, runtime  # noqa: TID251

    first, own = runtime.default_device, threading.local()

    class Threaded(Runtime):  # type: ignore[misc]
        @property
        def default_device(self) -> Any:
            return getattr(own, "device", first)

        @default_device.setter
        def default_device(self, device: Any) -> None:
            own.device = device

    runtime.__class__ = Threaded


def start() -> None:
    """Initialise Warp once, warnings only; anything but the remark on the missing driver still reaches stderr."""
    global _started
    with _lock:
        if _started:
            return
        wp.config.log_level = 30
        if folder := kernel_cache():
            wp.config.kernel_cache_dir = str(folder)
        sys.stderr.flush()
        kept = os.dup(2)
        with tempfile.TemporaryFile() as caught:
            os.dup2(caught.fileno(), 2)
            try:
                wp.init()
            finally:
                os.dup2(kept, 2)
                os.close(kept)
            caught.seek(0)
            for line in caught:
                if _HARMLESS not in line:
                    os.write(2, line)
        _default_of_each_thread()
        lay_out(Path(wp.config.kernel_cache_dir))
        _started = True


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
