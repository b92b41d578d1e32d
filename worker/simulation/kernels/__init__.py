"""Warp kernels. Gradients are hand-written: Warp's tape is silently wrong for loops updating locals.

Arguments of a kernel begin with the constant model: hand, object, points, options. Hand data that it reads, other
inputs, data that it writes, and other outputs follow. Names end in `_in` or `_out`; an `_inout` argument is read and
written, and is an output. Quaternions are x y z w in these modules only. Each module compiles on first use and is
cached on disk. The object frame of all kernels has its origin at the centre of mass."""

from __future__ import annotations

import threading
from importlib import import_module
from typing import Final

import warp as wp

from graspd.worker.engines import backend

backend.start()

MODULES: Final = (
    "kinematics",
    "surface",
    "reaching",
    "contact",
    "pieces",
    "penalties",
    "optimizers",
    "projection",
    "obstacles",
    "solids",
    "chain",
)
_lock = threading.Lock()


def load(device: str) -> None:
    """Compile or load all kernels for a device. Warp must not load a module from two threads."""
    with _lock:
        for name in MODULES:
            wp.load_module(import_module(f"{__name__}.{name}"), device=device)
