"""A machine with far more to do than it can: tasks take longer, and nobody is called lost."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from graspd.service.model.states import State
from tests.fakes import request
from tests.system.conftest import System

pytestmark = pytest.mark.chaos
#: Busy processes a core.
BUSY = 7.5
#: A busy process ends by itself, should nobody end it [s].
_LONGEST_S = 600
_BUSY = f"import time\nend = time.monotonic() + {_LONGEST_S}\nwhile time.monotonic() < end: pass"


@contextmanager
def load() -> Iterator[None]:
    """Busy processes: 15 on two cores."""
    count = round(BUSY * len(os.sched_getaffinity(0)))
    command = [sys.executable, "-m", "graspd.service.run.launch", str(os.getpid()), sys.executable, "-c", _BUSY]
    busy = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
        for process in busy:
            process.wait()


@pytest.mark.slow
@pytest.mark.timeout(_LONGEST_S)
def test_on_a_busy_machine_no_worker_is_lost_though_its_tasks_let_nothing_else_run(
    start: Callable[..., System],
) -> None:
    """Each task holds the interpreter lock for two leases, as a kernel that compiles does."""
    system = start(workers=2, environment={"FAKE_LOCK_S": "4"}, lease_s=2.0, task_attempts=1)
    # That they start is no part of it, and would take the tests beside this one their processors for long.
    system.until(lambda: [beat.state for beat in system.services.queue.workers()] == ["idle"] * 2, "both can work")
    with load():
        job = system.submit(request(grasps=32 * 2))
        (done,) = system.finish(job, seconds=_LONGEST_S / 2)
    assert system.services.index.jobs.attempts() == []
    assert (done.state, done.grasps) == (State.SUCCEEDED, 32 * 2)
    assert "lost" not in {worker.state for worker in system.services.index.overview.workers()}
