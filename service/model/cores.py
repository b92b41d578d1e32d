"""CPU cores and memory of this process: limits of affinity and control groups, not of the machine."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Final

ROOT: Final = Path("/")
#: Cache lifetime of a quota [s].
_LATELY_S: Final = 2.0
#: Mount points of the CPU controller of cgroup v1.
_V1: Final = ("cpu", "cpu,cpuacct")


def available_cores(root: Path = ROOT) -> int:
    """Return the cores for this process: its affinity, or its control group's quota, rounded up, if less."""
    given = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min([given, *(math.ceil(quota) for quota in _lately(root, int(time.monotonic() / _LATELY_S)))]))


@lru_cache(maxsize=1)
def _lately(root: Path, moment: int) -> list[float]:
    """Return the quotas, cached per time slot; reading the files takes milliseconds."""
    return list(_quotas(root))


def _quotas(root: Path) -> Iterator[float]:
    """Yield the quotas [cores] of this process's control group and its ancestors."""
    mount = root / "sys/fs/cgroup"
    for controllers, path in _groups(root / "proc/self/cgroup"):
        inside = (PurePosixPath(path), *PurePosixPath(path).parents)
        for group in (str(one).lstrip("/") for one in inside):
            if not controllers:
                yield from _ratio(_words(mount / group / "cpu.max"))
            elif "cpu" in controllers.split(","):
                for name in _V1:
                    files = (mount / name / group / f"cpu.cfs_{what}_us" for what in ("quota", "period"))
                    yield from _ratio([word for file in files for word in _words(file)])


def available_memory(root: Path = ROOT) -> int:
    """Return the memory for this process [bytes]: the machine's, or its control group's limit if less."""
    return min([os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *_memory_limits(root)])


def _memory_limits(root: Path) -> Iterator[int]:
    """Yield the memory limits [bytes] of this process's control group and its ancestors, where set."""
    mount = root / "sys/fs/cgroup"
    for controllers, path in _groups(root / "proc/self/cgroup"):
        for group in (str(one).lstrip("/") for one in (PurePosixPath(path), *PurePosixPath(path).parents)):
            words = []
            if not controllers:
                words = _words(mount / group / "memory.max")
            elif "memory" in controllers.split(","):
                words = _words(mount / "memory" / group / "memory.limit_in_bytes")
            yield from (int(word) for word in words if word.isdigit() and int(word) > 0)


def _groups(file: Path) -> Iterator[tuple[str, str]]:
    """Yield controllers and path of each hierarchy of the process; no controllers: cgroup v2."""
    try:
        lines = file.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        yield controllers, path


def _words(file: Path) -> list[str]:
    try:
        return file.read_text().split()
    except OSError:
        return []


def _ratio(words: list[str]) -> Iterator[float]:
    """Yield quota over period; nothing if unlimited (`max`, -1)."""
    try:
        quota, period = map(int, words)
    except ValueError:
        return
    if quota > 0 and period > 0:
        yield quota / period
