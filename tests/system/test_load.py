"""A machine with far more to do than it can: tasks take longer, and nobody is called lost."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest

from service.model.domain import State
from tests.fakes import request
from tests.system.conftest import System

pytestmark = pytest.mark.chaos
#: Busy processes a core.
BUSY = 7.5
#: A busy process ends by itself, should nobody end it [s].
_LONGEST_S = 600
_BUSY = f"import time\nend = time.monotonic() + {_LONGEST_S}\nwhile time.monotonic() < end: pass"


@pytest.fixture
def load() -> Iterator[int]:
    """So many busy processes: 15 on two cores."""
    count = round(BUSY * len(os.sched_getaffinity(0)))
    command = [sys.executable, "-m", "service.run.launch", str(os.getpid()), sys.executable, "-c", _BUSY]
    busy = [subprocess.Popen(command) for _ in range(count)]
    yield count
    for process in busy:
        process.kill()
    for process in busy:
        process.wait()


@pytest.mark.timeout(_LONGEST_S)
def test_on_a_busy_machine_no_worker_is_lost_though_its_tasks_let_nothing_else_run(
    start: Callable[..., System], load: int
) -> None:
    """Each task holds the interpreter lock for longer than a lease, as a kernel that compiles does."""
    system = start(workers=2, environment={"FAKE_LOCK_S": "3"}, lease_s=2.0, task_attempts=1)
    job = system.submit(request(grasps=32 * 6))
    (done,) = system.finish(job, seconds=_LONGEST_S / 2)
    assert system.parts.index.jobs.attempts() == []
    assert (done.state, done.grasps) == (State.SUCCEEDED, 32 * 6)
    assert "lost" not in {worker.state for worker in system.parts.index.overview.workers()}
