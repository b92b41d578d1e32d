"""CPU cores and memory available to this process, by affinity and control groups."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Final

ROOT: Final = Path("/")
_LATELY_S: Final = 2.0


def available_cores(root: Path = ROOT) -> int:
    """Return the number of cores of this process: the least of its affinity and its rounded-up quotas."""
    given = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min([given, *(math.ceil(quota) for quota in _quota_cache(root, int(time.monotonic() / _LATELY_S)))]))


@lru_cache(maxsize=1)
def _quota_cache(root: Path, moment: int) -> list[float]:
    """Return the quotas, cached per time slot, because reading the files takes milliseconds."""
    return list(_quotas(root))


def _quotas(root: Path) -> Iterator[float]:
    """Yield the quotas [cores] of this process's control group and its ancestors, except unlimited ones."""
    for text in _limits(root, "cpu.max"):
        try:
            quota, period = map(int, text.split())
        except ValueError:  # "max 100000" means no limit.
            continue
        if quota > 0 and period > 0:
            yield quota / period


def available_memory(root: Path = ROOT) -> int:
    """Return the memory [bytes] of this process: the machine's, or its control group's limit if lower."""
    limits = (text.strip() for text in _limits(root, "memory.max"))
    given = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([given, *(int(text) for text in limits if text.isdigit() and int(text) > 0)])


def _limits(root: Path, name: str) -> Iterator[str]:
    """Yield the content of file `name` in the process's control group (version 2) and each ancestor."""
    for line in _text(root / "proc/self/cgroup").splitlines():
        path = PurePosixPath(line.partition("::")[2])
        for group in (path, *path.parents):
            yield _text(root / "sys/fs/cgroup" / str(group).lstrip("/") / name)


def _text(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:
        return ""
