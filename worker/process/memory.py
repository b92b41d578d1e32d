"""How much memory this process holds. Engines and drivers leak: a worker that grew makes room for a new one."""

from __future__ import annotations

import os
import resource
import sys
from pathlib import Path
from typing import Final

from service.model.cores import ROOT, memory_limits

_STATUS: Final = Path("/proc/self/statm")


def resident_mb(pid: int | None = None) -> float:
    """Resident memory of this process, or of another [MiB]; where the system does not tell, the most this one ever
    had, or nothing of another."""
    try:
        pages = int((_STATUS if pid is None else Path(f"/proc/{pid}/statm")).read_text().split()[1])
    except (OSError, ValueError, IndexError):
        if pid is not None:
            return 0.0
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (2**20 if sys.platform == "darwin" else 2**10)
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def limit_mb(wanted: int, root: Path = ROOT) -> float:
    """The limit of a worker [MiB]: as given; for 0 half of the machine's memory, or of its control group's if less.

    Args:
        root: the folder that holds `proc` and `sys`.
    """
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return wanted or min([machine, *memory_limits(root)]) / 2**20 / 2
