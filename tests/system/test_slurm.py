"""The batch scripts on a cluster that kills: nothing is lost, nothing is done twice."""

import os
import stat
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from redis import Redis
from redis.exceptions import AuthenticationError

from graspd.service.model.states import State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.queue.connection import redis_url
from graspd.service.run.address import new_listen_address
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from tests.conftest import REPOSITORY
from tests.deploy.slurm import FakeSlurm
from tests.fakes import add_assets, request
from tests.system.conftest import System
from tests.waiting import PATIENCE_S, answers, until

SLURM = REPOSITORY / "docker" / "slurm"


def command(path: Path, module: str) -> Path:
    """An executable `graspd` that is a module of this environment."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'#!/bin/sh\n[ "$1" = worker ] && shift\nexec {sys.executable} -m {module} "$@"\n')
    path.chmod(0o755)
    return path


def environment(shared: Path, **more: str) -> dict[str, str]:
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("GRASPD_", "SLURM_"))}
    return {**plain, "SHARED": str(shared), "PYTHONPATH": str(REPOSITORY), "RETRY_S": "1", **more}


@pytest.fixture
def slurm(tmp_path: Path) -> Iterator[FakeSlurm]:
    cluster = FakeSlurm(tmp_path / "slurm")
    yield cluster
    cluster.close()


@pytest.mark.slow
@pytest.mark.chaos
def test_preemption_a_lost_node_and_a_time_limit_lose_nothing(tmp_path: Path, slurm: FakeSlurm) -> None:
    shared = tmp_path / "shared"
    store, quick = (shared / "store").as_uri(), {"controller_interval_s": 0.3, "lease_s": 2.0, "task_s": 0.0}
    settings = Settings(data_dir=tmp_path / "data", store_url=store, **quick)
    others = new_listen_address(settings, shared / "join.env", host="127.0.0.1")
    supervisor = Supervisor(settings, workers=0, api=False, joining=others)
    fakes = command(tmp_path / "bin" / "graspd", "tests.fakes")
    supervisor.start()
    try:
        supervisor.wait_ready(PATIENCE_S)
        hold = tmp_path / "hold"
        system = System(supervisor, hold)
        assert stat.S_IMODE((shared / "join.env").stat().st_mode) == 0o600
        job = job_actions.submit(system.services, request(grasps=32 * 16))[0].id
        hold.touch()
        slow = {"FAKE_SECONDS": "0.2", "FAKE_HOLD": str(hold), "GRASPD_LEASE_S": "2", "IDLE_S": "2"}
        slow = environment(shared, GRASPD=str(fakes), **slow)
        first, second, third = slurm.sbatch(SLURM / "worker.sbatch", slow, array=3)
        busy = lambda: len(system.services.index.jobs.tasks(job=job, state=State.RUNNING).items)  # noqa: E731
        system.until(lambda: busy() == 3, f"three busy workers\n{slurm.logs()}")
        slurm.preempt(second, grace_s=PATIENCE_S)
        assert slurm.reach_time_limit(first, notice_s=PATIENCE_S), slurm.logs()
        slurm.lose_node(third)
        hold.unlink()
        (done,) = system.finish(job)
        assert done.state is State.SUCCEEDED
        tasks = system.services.index.jobs.tasks(job=job, limit=100).items
        assert len(tasks) == 16
        # Who is told hands the task back at once; only the node that was lost used up an attempt.
        assert sum(task.attempt > 1 for task in tasks) <= 1, [task.attempt for task in tasks]
        shards = [path.stem for path in (shared / "store" / "shards" / "base").glob("*.h5")]
        assert len(shards) == len(set(shards)) == 16
        for element in (first, second, third):
            assert element.wait(PATIENCE_S) == 0, slurm.logs()
            assert element.restarts == 1
        system.services.close()
    finally:
        supervisor.stop()
    assert not (shared / "join.env").exists(), "it goes with its service"


@pytest.mark.slow
@pytest.mark.chaos
def test_the_service_of_a_lost_node_starts_anew_elsewhere(tmp_path: Path, slurm: FakeSlurm) -> None:
    """The node's disk is lost with it: index and queue are made again from the store."""
    shared = tmp_path / "shared"
    services = Services.open(Settings(data_dir=shared / "elsewhere", store_url=(shared / "store").as_uri()))
    add_assets(services)
    services.close()
    real = command(tmp_path / "bin" / "real" / "graspd", "graspd")
    fakes = command(tmp_path / "bin" / "fake" / "graspd", "tests.fakes")
    quick = {"GRASPD_LEASE_S": "2", "GRASPD_CONTROLLER_INTERVAL_S": "0.3", "GRASPD_PORT": "0", "GRASPD_TASK_S": "0"}
    quick["JOIN_HOST"] = "127.0.0.1"
    nodes = [environment(shared, GRASPD=str(real), TMPDIR=str(tmp_path / node), **quick) for node in ("node1", "node2")]
    for node in ("node1", "node2"):
        (tmp_path / node).mkdir()
    (service,) = slurm.sbatch(SLURM / "service.sbatch", nodes[0])
    slow = environment(shared, GRASPD=str(fakes), FAKE_SECONDS="0.5", GRASPD_LEASE_S="2", IDLE_S="30", KILL_S="2")
    (worker,) = slurm.sbatch(SLURM / "worker.sbatch", slow, array=1)
    job = submitted(shared, slurm)
    service.environment = {**service.environment, "TMPDIR": nodes[1]["TMPDIR"]}
    before = (shared / "join.env").read_text()
    slurm.lose_node(service)
    until(lambda: joined(shared) not in (None, before), f"the service starts again\n{slurm.logs()}")
    manifests = shared / "store" / "shards" / "base"
    until(lambda: len(list(manifests.glob("*.json"))) == 8, f"8 shards of {job}\n{slurm.logs()}")
    assert worker.restarts == 0, "the worker found the service by itself"
    assert slurm.reach_time_limit(service, notice_s=PATIENCE_S), slurm.logs()


def joined(shared: Path) -> str | None:
    try:
        return (shared / "join.env").read_text()
    except FileNotFoundError:
        return None


def submitted(shared: Path, slurm: FakeSlurm) -> str:
    """A job of eight batches, submitted to the service that wrote the file; returns when a part is done."""
    until(lambda: joined(shared) is not None, f"a service\n{slurm.logs()}")
    said = dict(line.split("=", 1) for line in (joined(shared) or "").splitlines())
    url = said["GRASPD_API_URL"]
    until(lambda: answers(f"{url}/readyz"), f"the API at {url}\n{slurm.logs()}")
    wanted = request(grasps=32 * 8).model_dump(mode="json", exclude_none=True)
    answer = httpx.post(f"{url}/v1/jobs", json=wanted, trust_env=False, timeout=60)
    assert answer.status_code == 202, answer.text
    done = shared / "store" / "shards" / "base"
    until(lambda: len(list(done.glob("*.json"))) >= 2, f"two shards\n{slurm.logs()}")
    return str(answer.json()["id"])


def test_redis_asks_for_the_password_of_the_file(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "data", store_url=(tmp_path / "store").as_uri())
    others = new_listen_address(settings, tmp_path / "shared" / "join.env", host="127.0.0.1")
    with Supervisor(settings, workers=0, api=False, joining=others) as supervisor:
        supervisor.wait_ready(PATIENCE_S)
        arguments = Path(f"/proc/{supervisor.pids['redis']}/cmdline").read_bytes().decode()
        assert others.password not in arguments, "every user of the machine reads arguments"
        assert Redis.from_url(others.redis_url).ping()
        assert Redis.from_url(redis_url(settings)).ping(), "commands on this machine know the password"
        with pytest.raises(AuthenticationError):
            Redis.from_url(f"redis://127.0.0.1:{others.port}").ping()
        for file in (tmp_path / "shared" / "join.env", settings.data_dir / "redis" / "password"):
            assert stat.S_IMODE(file.stat().st_mode) == 0o600
    with Supervisor(settings, workers=0, api=False) as alone:
        alone.wait_ready(PATIENCE_S)
        assert Redis.from_url(redis_url(settings)).ping(), "without --share there is no password any more"
