"""Processes that work for one: the same results in order, and nothing that hangs whatever becomes of them."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from graspd.service.model.errors import TaskCancelled
from graspd.worker.engines.batch_sizes import BYTES_PER_PROCESS, PROCESS_SHARE, pool_process_count
from graspd.worker.pool.pool import KEPT, Pool, ProcessLost
from tests.service.model.test_cores import system
from tests.waiting import until
from tests.worker.pool import works


@pytest.fixture(scope="module")
def pool():
    with Pool(2) as made:
        yield made


def alive(pid: int) -> bool:
    try:
        # Threads may outlive the first one, which is a zombie by then.
        states = [file.read_text().rpartition(")")[2].split()[0] for file in Path(f"/proc/{pid}/task").glob("*/stat")]
    except OSError:
        return Path(f"/proc/{pid}").exists()
    return any(state != "Z" for state in states)


def test_results_come_in_the_order_of_their_parts(pool: Pool) -> None:
    told: list[int] = []
    assert pool.map(works.times, "three", 3, range(20), done=told.append) == [3 * part for part in range(20)]
    assert sorted(told) == list(range(20))
    assert pool.map(works.times, "three", 3, []) == []


def test_other_processes_do_it(pool: Pool) -> None:
    found = set(pool.map(works.own_pid, "none", None, range(8)))
    assert found <= set(pool.pids) and os.getpid() not in found


def test_what_was_forgotten_is_sent_again(pool: Pool) -> None:
    for number in (*range(2 * KEPT), *range(2 * KEPT)):
        assert pool.map(works.times, f"factor {number}", number, [1, 1, 1]) == [number] * 3


def test_an_error_comes_as_it_was_raised(pool: Pool) -> None:
    with pytest.raises(ValueError, match="part 2") as found:
        pool.map(works.fail, "part", "part", [0, 2])
    assert "in fail" in found.value.__notes__[0]
    with pytest.raises(RuntimeError, match="Odd: very odd"):
        pool.map(works.fail_oddly, "none", None, [0])


def test_a_process_that_is_killed_fails_what_it_did_and_is_replaced(pool: Pool) -> None:
    with pytest.raises(ProcessLost, match="signal 9"):
        pool.map(works.be_killed, "none", None, [0])
    assert pool.map(works.times, "three", 3, range(6)) == [0, 3, 6, 9, 12, 15]


def test_one_that_was_killed_while_it_waited_is_replaced(pool: Pool) -> None:
    pool.map(works.times, "three", 3, range(6))
    for pid in pool.pids:
        os.kill(pid, signal.SIGKILL)
        until(lambda pid=pid: not alive(pid), "it is dead")
    assert pool.map(works.times, "three", 3, range(6)) == [0, 3, 6, 9, 12, 15]


@pytest.mark.timeout(60)
@pytest.mark.parametrize(("processes", "patience_s"), [(2, 600), (1, 0)], ids=["by another", "by one in its place"])
def test_who_is_cancelled_waits_no_longer_and_others_are_served(processes, patience_s, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("graspd.worker.pool.pool._PATIENCE_S", patience_s)
    with Pool(processes) as pool:
        with pytest.raises(TaskCancelled):
            pool.map(works.hang, "folder", tmp_path, [0], cancelled=lambda: any(tmp_path.iterdir()))
        assert pool.map(works.times, "three", 3, [1, 2]) == [3, 6]
        pids = pool.pids
    assert not any(alive(pid) for pid in pids), "processes end with their pool, whatever they do"
    with pytest.raises(TaskCancelled):
        pool.map(works.times, "three", 3, [1])


def test_processes_end_with_the_one_that_started_them(tmp_path: Path) -> None:
    program = (
        "from pathlib import Path; from graspd.worker.pool.pool import Pool; from tests.worker.pool import works; "
        f"Pool(2).map(works.hang, 'folder', Path({str(tmp_path)!r}), [0, 1])"
    )
    parent = subprocess.Popen([sys.executable, "-c", program])
    try:
        until(lambda: len(list(tmp_path.iterdir())) == 2 or parent.poll() is not None, "both work")
    finally:
        parent.kill()
        parent.wait()
    pids = [int(file.name) for file in tmp_path.iterdir()]
    assert len(pids) == 2
    until(lambda: not any(alive(pid) for pid in pids), "they end")


def machine(root: Path, cores: int, memory: int) -> Path:
    """A root folder as a container of so many cores and so much memory sees it."""
    return system(root, "0::/", {"cpu.max": f"{cores * 100_000} 100000", "memory.max": str(memory)})


def test_how_many_there_are_where_nobody_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(64), raising=False)
    monkeypatch.setattr(os, "sysconf", lambda name: {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 1 << 26}[name])
    room = round(BYTES_PER_PROCESS / PROCESS_SHARE)
    big = machine(tmp_path / "big", 16, 40 * room)
    assert pool_process_count("cuda:0", 0, root=big) == 15
    assert pool_process_count("cuda:1", 0, root=big, workers=4) == 3, "workers of one machine share its cores"
    assert pool_process_count("cuda:0", 0, root=big, threads=5) == 4
    assert pool_process_count("cpu", 0, root=big) == 1, "the planner takes the cores at other times"
    assert [pool_process_count(device, 6, root=big) for device in ("cpu", "cuda:0")] == [6, 6]
    assert pool_process_count("cuda:0", 0, root=machine(tmp_path / "two", 2, 40 * room)) == 1
    assert pool_process_count("cuda:0", 0, root=machine(tmp_path / "poor", 16, 3 * room)) == 3
