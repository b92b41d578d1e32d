"""A rolling upgrade: the service is of the next version, and workers of 0.2 and of the next one run side by side."""

from __future__ import annotations

import io
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from graspd.service.model.states import State
from graspd.service.model.version import STAGE_REVISIONS
from graspd.service.pipeline import job_actions
from tests.conftest import REPOSITORY
from tests.fakes import request
from tests.system.house import House

#: The commit of graspd 0.2.
PREVIOUS = "55f607e"
#: Revisions of synthesize that it and the next version make.
OLD, NEW = 23, 24
MAKES = "from graspd.service.model.version import STAGE_REVISIONS; STAGE_REVISIONS['synthesize'] = {};"


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    # Nobody is killed here: on a busy machine a worker may be silent for long and is there all the same.
    made = House(tmp_path, lease_s=60.0)
    yield made
    made.close()


def older_worker(house: House, folder: Path) -> None:
    """A worker of 0.2 from the history; of today's code and the revision of 0.2 where there is none."""
    command = ["git", "archive", "--format=tar", PREVIOUS, "service", "worker", "tests"]
    found = subprocess.run(command, cwd=REPOSITORY, capture_output=True, check=False)
    if found.returncode == 0:
        with tarfile.open(fileobj=io.BytesIO(found.stdout)) as archive:
            archive.extractall(folder, filter="data")
        # Neither it nor its children run the code of the folder that the tests run in.
        house.start("older", sys.executable, "-m", "tests.fakes", PYTHONPATH=str(folder), PYTHONSAFEPATH="1")
    else:
        house.start("older", sys.executable, "-m", "tests.fakes", FAKE_REVISION=str(OLD))


@pytest.mark.slow
@pytest.mark.chaos
def test_each_version_of_worker_takes_what_it_can(
    house: House, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def submit(seed: int, *, revision: int) -> str:
        with monkeypatch.context() as patch:
            patch.setitem(STAGE_REVISIONS, "synthesize", revision)
            return job_actions.submit(house.services, request(grasps=96, seed=seed))[0].id

    def state(job: str) -> State:
        return house.services.index.jobs.get(job).state

    older_worker(house, tmp_path / "previous")
    # While there is no worker, those of this version are expected.
    house.until(house.services.queue.workers, "the older worker says that it is there")
    before = submit(1, revision=OLD)
    house.start(
        "controller", sys.executable, "-c", MAKES.format(NEW) + "from graspd.cli import main; main()", "controller"
    )
    house.until(lambda: state(before) is State.SUCCEEDED, "the older worker does what was planned before the upgrade")

    after = submit(2, revision=NEW)
    house.until(
        lambda: house.says("controller", "held back, no worker that is here can do it"), "the controller says so"
    )
    assert state(after) is State.QUEUED
    tasks = house.services.index.jobs.tasks(job=after, limit=10).items
    assert [task.attempt for task in tasks] == [1] * 3
    assert all("held back" in str(task.message) for task in tasks)

    house.start("next", sys.executable, "-m", "tests.fakes", FAKE_REVISION=str(NEW))
    late = submit(3, revision=OLD)
    house.until(lambda: state(after) is State.SUCCEEDED, "the next version's worker does what was planned for it")
    house.until(lambda: state(late) is State.SUCCEEDED, "the older one still does what is left for it")

    for job, worker in ((before, "older"), (after, "next"), (late, "older")):
        tasks = house.services.index.jobs.tasks(job=job, limit=10).items
        assert [task.attempt for task in tasks] == [1] * 3, "no attempt failed"
        assert all(f"-{house.processes[worker].pid}-" in str(task.worker) for task in tasks)
