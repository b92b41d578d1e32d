"""Modules imported without the garbage collector: what they make is no garbage, and there is much of it.

A room's modules are half a million objects. Each collection while they come looks at all that are there already, and so
does each full one afterwards, the last of them when the process ends: half of what a start and an end take.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

_ours = False


def own_process() -> None:
    """This process is graspd's own: what was imported stays until it ends, and collections leave it out.

    In somebody else's process their garbage would stay as well.
    """
    global _ours
    _ours = True


@contextmanager
def imports() -> Iterator[None]:
    """Import in here."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if _ours:
            gc.freeze()
        if collects:
            gc.enable()
