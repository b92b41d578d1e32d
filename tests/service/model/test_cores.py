"""Cores and memory are those that the process is given: affinity and control groups of both versions."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from graspd.service.model import cores
from graspd.service.model.cores import available_cores, available_memory
from tests.conftest import PACKAGES

MACHINE = 16
MACHINE_MB = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**20


@pytest.fixture(autouse=True)
def many_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2 * MACHINE)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(MACHINE)), raising=False)


def write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text + "\n")


def system(root: Path, group: str, **files: str) -> Path:
    """A file system in which this process is in `group`; names of files are paths, with __ for a slash."""
    held = {"proc/self/cgroup": group}
    held |= {"sys/fs/cgroup/" + name.replace("__", "/").replace("_max", ".max"): text for name, text in files.items()}
    write(root, held)
    return root


def v1(root: Path, folder: str, quota: int) -> None:
    place = f"sys/fs/cgroup/{folder}"
    write(root, {f"{place}/cpu.cfs_quota_us": str(quota), f"{place}/cpu.cfs_period_us": "100000"})


def test_without_control_groups_the_affinity_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert available_cores(tmp_path) == MACHINE
    monkeypatch.delattr(os, "sched_getaffinity")
    assert available_cores(tmp_path) == 2 * MACHINE


@pytest.mark.parametrize(
    ("limit", "expected"),
    [("200000 100000", 2), ("150000 100000", 2), ("50000 100000", 1), ("max 100000", MACHINE), ("9900000 100000", 16)],
)
def test_the_quota_of_a_container_counts(tmp_path: Path, limit: str, expected: int) -> None:
    assert available_cores(system(tmp_path, "0::/", cpu_max=limit)) == expected


def test_the_least_quota_on_the_way_up_counts(tmp_path: Path) -> None:
    root = system(tmp_path, "0::/pods/mine", pods__cpu_max="300000 100000", pods__mine__cpu_max="max 100000")
    assert available_cores(root) == 3


@pytest.mark.parametrize(
    ("folder", "quota", "cores"), [("cpu", 400_000, 4), ("cpu,cpuacct", 400_000, 4), ("cpu", -1, MACHINE)]
)
def test_the_quota_of_version_1_counts(tmp_path: Path, folder: str, quota: int, cores: int) -> None:
    # In a container the path is the host's, and only the controller's root is there.
    root = system(tmp_path, "4:memory:/docker/x\n3:cpu,cpuacct:/docker/x\n0::/")
    v1(root, folder, quota)
    assert available_cores(root) == cores


@pytest.mark.parametrize("text", ["", "what", "1 2 3", "100000 0"])
def test_what_cannot_be_read_is_no_limit(tmp_path: Path, text: str) -> None:
    assert available_cores(system(tmp_path, "0::/", cpu_max=text)) == MACHINE


def test_no_other_count_of_cores_is_asked_for() -> None:
    here = Path(__file__).parents[3]
    packages = (*PACKAGES, "benchmarks", "examples")
    files = [file for package in packages for file in (here / package).rglob("*.py")] + list(here.glob("*.py"))
    asking = [file for file in files if re.search(r"cpu_count\(|sched_getaffinity\(", file.read_text())]
    assert asking == [here / "service/model/cores.py"]


def test_the_files_are_read_once_in_a_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(cores.time, "monotonic", lambda: now[0])
    root = system(tmp_path, "0::/", cpu_max="300000 100000")
    assert available_cores(root) == 3
    system(tmp_path, "0::/", cpu_max="200000 100000")
    assert available_cores(root) == 3
    now[0] += 2
    assert available_cores(root) == 2


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
    write(tmp_path, {"proc/self/cgroup": group, **{f"sys/fs/cgroup/{name}": text for name, text in files.items()}})
    assert available_memory(tmp_path) / 2**20 == pytest.approx(limit)
