"""Cores and memory that the process is given, and imports without the garbage collector."""

import gc
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from graspd.service.model import cores, libraries
from graspd.service.model.cores import available_cores, available_memory
from graspd.service.model.libraries import freeze_imports, pause_garbage_collection
from tests.conftest import PACKAGES, REPOSITORY

MACHINE = 16
MACHINE_MB = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**20


@pytest.fixture(autouse=True)
def many_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2 * MACHINE)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(MACHINE)), raising=False)


def system(root: Path, group: str, files: dict[str, str]) -> Path:
    """A file system in which this process is in `group`."""
    held = {"proc/self/cgroup": group} | {f"sys/fs/cgroup/{name}": text for name, text in files.items()}
    for name, text in held.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text + "\n")
    return root


def test_without_control_groups_the_affinity_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert available_cores(tmp_path) == MACHINE
    monkeypatch.delattr(os, "sched_getaffinity")
    assert available_cores(tmp_path) == 2 * MACHINE


@pytest.mark.parametrize(
    ("group", "files", "expected"),
    [
        ("0::/", {"cpu.max": "150000 100000"}, 2),
        ("0::/", {"cpu.max": "50000 100000"}, 1),
        ("0::/", {"cpu.max": "9900000 100000"}, MACHINE),
        *[("0::/", {"cpu.max": text}, MACHINE) for text in ("max 100000", "", "what", "1 2 3", "100000 0")],
        ("0::/pods/mine", {"pods/cpu.max": "300000 100000", "pods/mine/cpu.max": "max 100000"}, 3),
    ],
)
def test_the_least_quota_on_the_way_up_counts(tmp_path: Path, group: str, files: dict[str, str], expected: int) -> None:
    assert available_cores(system(tmp_path, group, files)) == expected


def test_no_other_count_of_cores_is_asked_for() -> None:
    packages = (*PACKAGES, "benchmarks", "examples")
    files = [file for package in packages for file in (REPOSITORY / package).rglob("*.py")]
    asking = [file for file in files if re.search(r"cpu_count\(|sched_getaffinity\(", file.read_text())]
    assert asking == [REPOSITORY / "service/model/cores.py"]


def test_the_files_are_read_once_in_a_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(cores.time, "monotonic", lambda: now[0])
    assert available_cores(system(tmp_path, "0::/", {"cpu.max": "300000 100000"})) == 3
    system(tmp_path, "0::/", {"cpu.max": "200000 100000"})
    assert available_cores(tmp_path) == 3
    now[0] += 2
    assert available_cores(tmp_path) == 2


@pytest.mark.parametrize(
    ("group", "files", "limit"),
    [
        ("0::/a/b", {"a/memory.max": "104857600", "a/b/memory.max": "max"}, 100.0),
        ("0::/", {"memory.max": "104857600"}, 100.0),
        ("0::/c", {"c/memory.max": "max"}, MACHINE_MB),
        ("9:memory:/c", {}, MACHINE_MB),
    ],
)
def test_the_smallest_memory_limit_counts(tmp_path: Path, group: str, files: dict[str, str], limit: float) -> None:
    assert available_memory(system(tmp_path, group, files)) / 2**20 == pytest.approx(limit)


@pytest.fixture(autouse=True)
def collects() -> object:
    gc.enable()
    yield
    gc.enable()


def test_nothing_is_collected_while_modules_come_even_if_one_fails() -> None:
    with pause_garbage_collection():
        with pause_garbage_collection():
            pass
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ModuleNotFoundError), pause_garbage_collection():
        import no_such_module  # type: ignore[import-not-found]  # noqa: F401
    assert gc.isenabled()


def test_a_caller_who_collects_himself_goes_on_so() -> None:
    gc.disable()
    with pause_garbage_collection():
        pass
    assert not gc.isenabled()


def test_only_a_process_of_graspd_s_own_keeps_what_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    frozen: list[bool] = []
    monkeypatch.setattr(gc, "freeze", lambda: frozen.append(True))
    monkeypatch.setattr(libraries, "_ours", False)
    with pause_garbage_collection():
        pass
    assert not frozen
    freeze_imports()
    with pause_garbage_collection():
        pass
    assert frozen


def test_the_command_line_is_such_a_process() -> None:
    code = (
        "import gc, sys; sys.argv = ['graspd', 'jobs', '--help']; import graspd.cli\n"
        "try: graspd.cli.main()\nfinally: print(gc.get_freeze_count() > 0, gc.isenabled(), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.split() == ["True", "True"]
