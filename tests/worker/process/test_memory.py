"""A worker's limit of memory is half of what it is given: of the machine's, or of its control group's."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from worker.process.memory import limit_mb

MACHINE_MB = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**20


@pytest.mark.parametrize(
    ("group", "files", "limit"),
    [
        ("0::/a/b", {"a/b/memory.max": "104857600"}, 50.0),
        ("0::/a/b", {"a/memory.max": "104857600", "a/b/memory.max": "max"}, 50.0),
        ("0::/", {"memory.max": "104857600"}, 50.0),
        ("9:memory:/c", {"memory/c/memory.limit_in_bytes": "209715200"}, 100.0),
        ("9:memory:/c", {"memory/c/memory.limit_in_bytes": "9223372036854771712"}, MACHINE_MB / 2),
        ("0::/a", {"a/memory.max": "max"}, MACHINE_MB / 2),
        ("9:cpu:/c", {}, MACHINE_MB / 2),
    ],
)
def test_the_smallest_limit_around_the_process_counts(
    tmp_path: Path, group: str, files: dict[str, str], limit: float
) -> None:
    for name, text in {"proc/self/cgroup": group, **{f"sys/fs/cgroup/{k}": v for k, v in files.items()}}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    assert limit_mb(0, tmp_path) == pytest.approx(limit)


def test_a_limit_that_is_given_counts(tmp_path: Path) -> None:
    assert limit_mb(300, tmp_path) == 300
