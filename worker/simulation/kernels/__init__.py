"""Warp kernels. Gradients are hand-written: Warp's tape is silently wrong for loops updating locals.

A kernel's arguments are the model (hand, object, points, options: all constant), hand data it reads, other inputs, data
it writes, other outputs. Names end in `_in` or `_out`; an `_inout` argument is read and written and is an output.
Quaternions are x y z w here, and here only. Each module compiles on first use and is cached on disk. The object frame
of all kernels has its origin at the centre of mass.
"""

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
