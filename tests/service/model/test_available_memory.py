"""Memory for a process is the machine's, or its control group's where that is less."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from graspd.service.model.cores import available_memory

MACHINE_MB = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**20


@pytest.mark.parametrize(
    ("group", "files", "limit"),
    [
        ("0::/a/b", {"a/b/memory.max": "104857600"}, 100.0),
        ("0::/a/b", {"a/memory.max": "104857600", "a/b/memory.max": "max"}, 100.0),
        ("0::/", {"memory.max": "104857600"}, 100.0),
        ("9:memory:/c", {"memory/c/memory.limit_in_bytes": "209715200"}, 200.0),
        ("9:memory:/c", {"memory/c/memory.limit_in_bytes": "9223372036854771712"}, MACHINE_MB),
        ("0::/a", {"a/memory.max": "max"}, MACHINE_MB),
        ("9:cpu:/c", {}, MACHINE_MB),
    ],
)
def test_the_smallest_limit_around_the_process_counts(
    tmp_path: Path, group: str, files: dict[str, str], limit: float
) -> None:
    for name, text in {"proc/self/cgroup": group, **{f"sys/fs/cgroup/{k}": v for k, v in files.items()}}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    assert available_memory(tmp_path) / 2**20 == pytest.approx(limit)
