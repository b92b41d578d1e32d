"""Several controllers, of which one leads; and a rolling upgrade with workers of 0.2 and of the next version."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from graspd.service.index.rebuild import differences
from graspd.service.model.states import State
from graspd.service.model.version import STAGE_REVISIONS
from graspd.service.pipeline import job_actions
from tests.conftest import REPOSITORY
from tests.fakes import request
from tests.system.house import House


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    made = House(tmp_path)
    yield made
    made.close()


@pytest.mark.chaos
def test_a_controller_killed_or_stopped_gives_way(house: House) -> None:
    house.controller("first")
    house.until(lambda: house.says("first", "this controller leads"), "the first leads")
    house.controller("second")
    house.until(lambda: house.says("second", "another controller leads"), "the second waits")
    early = job_actions.submit(house.services, request(seed=1))[0].id
    house.start("worker", sys.executable, "-m", "tests.fakes", FAKE_SECONDS="0.2")
    house.until(lambda: house.done(early) == 1, "the first keeps")

    house.hold.touch()
    job = job_actions.submit(house.services, request(grasps=32 * 24))[0].id
    house.until(lambda: house.services.index.jobs.tasks(job=job, state=State.RUNNING).items, "the worker has a task")
    house.processes["first"].kill()
    house.processes["first"].wait()
    house.until(lambda: house.says("second", "this controller leads"), "the second takes over")
    assert house.done(job) == 0
    house.hold.unlink()
    house.until(lambda: house.done(job) >= 2, "the second keeps")

    house.hold.touch()
    house.controller("third")
    house.until(lambda: house.says("third", "another controller leads"), "the third waits")
    house.processes["second"].send_signal(signal.SIGSTOP)
    house.until(lambda: house.says("third", "this controller leads"), "the third takes over")
    house.processes["second"].send_signal(signal.SIGCONT)
    house.until(lambda: house.says("second", "another leads now"), "the second notices")
    house.hold.unlink()

    house.until(lambda: house.services.index.jobs.get(job).state.is_final, "the job is done")
    tasks = house.services.index.jobs.tasks(job=job, limit=100).items
    assert {task.state for task in tasks} == {State.SUCCEEDED}
    assert [task.attempt for task in tasks] == [1] * 24, "no task was taken from its worker"
    assert house.says("worker", "synthesize took") == 1 + 24, "none was done twice"
    house.until(lambda: differences(house.services.index, house.services.store) == [], "the index is the store")

    # A controller that ends in order gives its lease back: the next one need not wait for it to run out.
    house.processes["third"].terminate()
    assert house.processes["third"].wait(60) == 0
    house.until(lambda: house.says("second", "this controller leads") == 2, "the second leads again")


@pytest.mark.slow
@pytest.mark.chaos
def test_one_that_is_started_again_under_its_name_need_not_wait(house: House) -> None:
    house.controller("first", GRASPD_CONTROLLER_NAME="node-1", GRASPD_LEASE_S="600")
    house.until(lambda: house.says("first", "this controller leads"), "the first leads")
    house.processes["first"].kill()
    house.processes["first"].wait()
    house.controller("again", GRASPD_CONTROLLER_NAME="node-1", GRASPD_LEASE_S="600")
    house.until(lambda: house.says("again", "this controller leads"), "it leads again")


#: The commit of graspd 0.2.
PREVIOUS = "55f607e"
#: Revisions of synthesize that it and the next version make.
OLD, NEW = 23, 24
MAKES = "from graspd.service.model.version import STAGE_REVISIONS; STAGE_REVISIONS['synthesize'] = {};"


@pytest.fixture
def calm_house(tmp_path: Path) -> Iterator[House]:
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
    calm_house: House, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    house = calm_house

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
        lambda: house.says("controller", "held back, because no present worker can do it"), "the controller says so"
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
