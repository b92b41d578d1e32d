"""Warp kernels. Gradients are hand-written: Warp's tape is silently wrong if loops update variables.

Order of arguments: the constant model (hand, object, points, options), hand data that is read, other inputs, hand data
that is written, other outputs. Names end in `_in` or `_out`; an `_inout` argument is read and written, and is an
output. Quaternions are x y z w in these modules only. Each module compiles on first use and is cached on disk. The
object frame of all kernels has its origin at the centre of mass."""

import threading
from importlib import import_module
from typing import Final

import warp as wp

from graspd.worker.engines import backend

backend.start_warp()

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
    """Compile or load `MODULES` for a device. Warp must not load a module from two threads at once."""
    with _lock:
        for name in MODULES:
            wp.load_module(import_module(f"{__name__}.{name}"), device=device)
