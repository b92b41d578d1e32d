"""CPU cores and memory available to this process, by affinity and control groups."""

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
    return max(1, min([given, *map(math.ceil, _cpu_quotas(root, int(time.monotonic() / _LATELY_S)))]))


@lru_cache(maxsize=1)
def _cpu_quotas(root: Path, moment: int) -> list[float]:
    """Return the limits [cores] of this process's control group and its ancestors.

    The cache holds them for one `moment`, because reading the files takes milliseconds.
    """
    # The text is "QUOTA PERIOD", or "max PERIOD" without a limit.
    texts = (text.split() for text in _control_group_values(root, "cpu.max"))
    pairs = [tuple(map(int, text)) for text in texts if len(text) == 2 and all(map(str.isdecimal, text))]
    return [quota / period for quota, period in pairs if quota > 0 and period > 0]


def available_memory(root: Path = ROOT) -> int:
    """Return the memory of this process [bytes]: the machine's, or its control group's limit if lower."""
    limits = (text.strip() for text in _control_group_values(root, "memory.max"))
    given = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([given, *(int(text) for text in limits if text.isdigit() and int(text) > 0)])


def _control_group_values(root: Path, name: str) -> Iterator[str]:
    """Yield the content of file `name` in this process's control group (version 2) and its ancestors."""
    for line in _read_text(root / "proc/self/cgroup").splitlines():
        path = PurePosixPath(line.partition("::")[2])
        for group in (path, *path.parents):
            yield _read_text(root / "sys/fs/cgroup" / str(group).lstrip("/") / name)


def _read_text(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:
        return ""
