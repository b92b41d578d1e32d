"""How many cores and how much memory this process may use: not what the machine has, but what it is given of it."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Final

ROOT: Final = Path("/")
#: A quota that was read is that of so long [s].
_LATELY_S: Final = 2.0
#: Where systems mount the CPU controller of cgroup v1.
_V1: Final = ("cpu", "cpu,cpuacct")


def available_cores(root: Path = ROOT) -> int:
    """Cores for threads of this process: its affinity, or the CPU quota of its control group where that is less.

    A quota of one and a half cores gives 2: a thread that waits for its share costs less than half a core unused. It is
    asked for before each piece of work, and a quota that is changed meanwhile is heard of within seconds.

    Args:
        root: the folder that holds `proc` and `sys`.
    """
    given = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min([given, *(math.ceil(quota) for quota in _lately(root, int(time.monotonic() / _LATELY_S)))]))


@lru_cache(maxsize=1)
def _lately(root: Path, moment: int) -> list[float]:
    """The quotas as they were when somebody first asked in a moment; the files are read in milliseconds."""
    return list(_quotas(root))


def _quotas(root: Path) -> Iterator[float]:
    """Quotas [cores] of this process's control group and of those it is in."""
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
    """Memory for this process [bytes]: the machine's, or the limit of its control group where that is less.

    Args:
        root: the folder that holds `proc` and `sys`.
    """
    return min([os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *_memory_limits(root)])


def _memory_limits(root: Path) -> Iterator[int]:
    """Limits of memory [bytes] of this process's control group and of those it is in; none where there is none."""
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
    """Controllers and path of each hierarchy that the process is in; no controllers: cgroup v2."""
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
    """Quota over period; none where there is no limit (`max`, -1)."""
    try:
        quota, period = map(int, words)
    except ValueError:
        return
    if quota > 0 and period > 0:
        yield quota / period
