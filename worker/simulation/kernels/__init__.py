"""Warp kernels. Gradients are written out by hand: Warp's tape is silently wrong for loops that update locals.

A kernel's arguments come in groups: the model (hand, object, points, options: what does not change), the data of the
hands that it reads, other inputs, the data that it writes, other outputs. They end in `_in` or `_out`; `_inout` is read
and written, and stands with the outputs. Launches give `inputs` and `outputs` in that order. Quaternions are x y z w
here, and here only. Each module compiles on first use and is cached on disk. The object frame of all kernels has its
origin at the centre of mass.
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
    """Compile, or read from the cache, all kernels for a device. Warp must not load one module from two threads."""
    with _lock:
        for name in MODULES:
            wp.load_module(import_module(f"{__name__}.{name}"), device=device)
