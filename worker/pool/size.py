"""How many processes a worker has beside itself, where nobody says."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from service.model.cores import ROOT, available_cores, memory_limits

#: Most memory of a process, with the models of the pairs that it keeps [bytes]; see docs/explanation/performance.md.
BYTES_PER_PROCESS: Final = 400 * 2**20
#: Share of the machine's memory for them.
MEMORY_SHARE: Final = 0.25


def processes_at_once(device: str, wanted: int, *, threads: int = 0, workers: int = 1, root: Path = ROOT) -> int:
    """Processes that judge and measure; 1: the worker's own, with threads.

    Where nobody says, a worker on a GPU has one for each core but its own, as far as a quarter of the memory goes. On a
    CPU the planner takes the same cores at other times, and threads do.

    Args:
        device: Warp device of the planner.
        wanted: so many; 0: nobody says.
        threads: CPU threads of the worker; 0: one for each core.
        workers: of this machine, which share its cores and its memory.
        root: the folder that holds `proc` and `sys`.
    """
    if wanted or not device.startswith("cuda"):
        return wanted or 1
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    room = int(MEMORY_SHARE * min([machine, *memory_limits(root)]) / workers / BYTES_PER_PROCESS)
    cores = min(threads or available_cores(root), max(1, available_cores(root) // workers))
    return max(1, min(cores - 1, room))
