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
#: Cache lifetime of a quota [s].
_LATELY_S: Final = 2.0
#: Mount points of the CPU controller of cgroup v1.
_V1: Final = ("cpu", "cpu,cpuacct")


def available_cores(root: Path = ROOT) -> int:
    """Return the number of cores for this process: its affinity or, if less, its control group's quota, rounded up."""
    given = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min([given, *(math.ceil(quota) for quota in _lately(root, int(time.monotonic() / _LATELY_S)))]))


@lru_cache(maxsize=1)
def _lately(root: Path, moment: int) -> list[float]:
    """Return the quotas, cached per time slot, because reading the files takes milliseconds."""
    return list(_quotas(root))


def _quotas(root: Path) -> Iterator[float]:
    """Yield the quotas [cores] of this process's control group and its ancestors."""
    mount = root / "sys/fs/cgroup"
    for controllers, group in _groups(root):
        if not controllers:
            yield from _ratio(_text(mount / group / "cpu.max"))
        elif "cpu" in controllers.split(","):
            for name in _V1:
                files = (mount / name / group / f"cpu.cfs_{what}_us" for what in ("quota", "period"))
                yield from _ratio(" ".join(map(_text, files)))


def available_memory(root: Path = ROOT) -> int:
    """Return the memory for this process [bytes]: the machine's, or its control group's limit if less."""
    return min([os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *_memory_limits(root)])


def _memory_limits(root: Path) -> Iterator[int]:
    """Yield the memory limits [bytes] of this process's control group and its ancestors, where set."""
    mount = root / "sys/fs/cgroup"
    for controllers, group in _groups(root):
        words = []
        if not controllers:
            words = _text(mount / group / "memory.max").split()
        elif "memory" in controllers.split(","):
            words = _text(mount / "memory" / group / "memory.limit_in_bytes").split()
        yield from (int(word) for word in words if word.isdigit() and int(word) > 0)


def _groups(root: Path) -> Iterator[tuple[str, str]]:
    """Yield the process's control groups and their ancestors, each with its controllers; no controllers: cgroup v2."""
    for line in _text(root / "proc/self/cgroup").splitlines():
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        for group in (PurePosixPath(path), *PurePosixPath(path).parents):
            yield controllers, str(group).lstrip("/")


def _text(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:
        return ""


def _ratio(text: str) -> Iterator[float]:
    """Yield quota over period; nothing if unlimited (`max`, -1)."""
    try:
        quota, period = map(int, text.split())
    except ValueError:
        return
    if quota > 0 and period > 0:
        yield quota / period
