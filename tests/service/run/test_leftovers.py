"""What an earlier `graspd up` left behind is ended; what only has its number, or its folder's name, is not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from graspd.service.run.address import record_address, recorded_address
from graspd.service.run.children import Child, end_leftovers, start_of
from tests.waiting import until

_WAIT = "import signal; signal.pause()"


@pytest.fixture
def stranger(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """An editor, say: the folder's path is in its command line and in its environment."""
    command = [sys.executable, "-c", _WAIT, str(tmp_path)]
    with subprocess.Popen(command, env={**os.environ, "GRASPD_DATA_DIR": str(tmp_path)}) as process:
        yield process
        process.kill()


@pytest.fixture
def child(tmp_path: Path) -> Iterator[Child]:
    made = Child("worker-0", (sys.executable, "-c", _WAIT), {}, tmp_path)
    made.start()
    assert made.process is not None
    # While it becomes its program, its environment cannot be read.
    command = Path(f"/proc/{made.process.pid}/cmdline")
    until(lambda: _WAIT in command.read_text() and "launch" not in command.read_text(), "the child runs")
    yield made
    made.process.kill()
    made.process.wait()


def pid_file(folder: Path, content: object) -> Path:
    file = folder / "run" / "worker-0.pid"
    file.parent.mkdir(exist_ok=True)
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    return file


def test_a_child_that_was_left_behind_is_ended(child: Child, tmp_path: Path) -> None:
    assert child.process is not None
    assert end_leftovers(tmp_path) == [child.process.pid]
    assert child.process.wait(timeout=60) < 0
    assert not list((tmp_path / "run").iterdir())


def test_a_process_that_got_the_number_of_a_child_lives_on(
    child: Child, stranger: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    assert child.pid_file is not None
    _, started, token = json.loads(child.pid_file.read_text())
    for stale in (
        [stranger.pid, started, token],
        [stranger.pid, start_of(stranger.pid), token],
        [stranger.pid, "", ""],
        str(stranger.pid),
    ):
        file = pid_file(tmp_path, stale)
        assert end_leftovers(tmp_path) == []
        assert stranger.poll() is None
        assert not file.exists()


@pytest.mark.parametrize(
    "pid",
    [os.getpid(), os.getppid(), 0, -1, 1, "1", None, 10**30, True],
    ids=["itself", "parent", "0", "-1", "1", "text", "none", "huge", "true"],
)
def test_up_ends_neither_itself_nor_its_parent_nor_nonsense(pid: object, tmp_path: Path) -> None:
    started = start_of(pid) if isinstance(pid, int) else ""
    pid_file(tmp_path, [pid, started, ""])
    assert end_leftovers(tmp_path) == []


def test_the_address_of_a_service_whose_number_another_process_has_is_not_believed(
    stranger: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    record_address(tmp_path, "http://127.0.0.1:45678")
    record = json.loads((tmp_path / "api.json").read_text())
    (tmp_path / "api.json").write_text(json.dumps(record | {"pid": stranger.pid}))
    assert recorded_address(tmp_path) is None
