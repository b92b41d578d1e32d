"""Warp, started quietly: on a machine without a GPU its C++ side says so on stderr at every start."""

from __future__ import annotations

import os
import sys
import tempfile
import threading

import warp as wp

from worker.engines.kernel_cache import kernel_cache

_HARMLESS = b"Could not find or load the NVIDIA CUDA driver"
_lock = threading.Lock()
_started = False


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
        _started = True
