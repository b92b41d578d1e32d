"""Workers that come, go and step aside, also on a cluster that kills; whose turn it is; parts that go away."""

import os
import re
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from redis import Redis
from redis.exceptions import AuthenticationError

from graspd.service.index.rebuild import differences
from graspd.service.model.clock import timestamp
from graspd.service.model.states import Priority, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.queue.connection import redis_url
from graspd.service.run.address import new_listen_address
from graspd.service.run.embedded import server_command
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from tests.conftest import REPOSITORY
from tests.deploy.slurm import FakeSlurm
from tests.fakes import add_assets, request
from tests.indexes import empty_index
from tests.servers import PostgresServer, S3Server
from tests.service.conftest import wait_for_redis
from tests.system.conftest import System
from tests.waiting import PATIENCE_S, answers, until

pytestmark = pytest.mark.chaos
Start = Callable[..., System]
#: Batches of a dataset that wait in the queue before a later small job.
_WAITING = 500
#: Of these may be done before it: those that run, every fourth turn, and what one worker does while the other has it.
_BEFORE_IT = 150
LEASE_S = 2.0


def test_a_worker_that_leaks_makes_room_before_it_holds_too_much(start: Start) -> None:
    system = start(environment={"FAKE_LEAK_MB": "200"}, worker_max_memory_mb=450)
    (done,) = system.finish(system.submit(request(grasps=32 * 6)))
    assert done.state is State.SUCCEEDED
    makers = {shard.worker for shard in system.services.index.shards.page(limit=200).items}
    assert len(makers) >= 3, "the second task is one too many for each"
    assert system.services.index.jobs.attempts() == []
    assert "lost" not in {worker.state for worker in system.services.index.overview.workers()}


def test_a_worker_is_shown_as_lost_if_killed_and_not_if_stopped(start: Start) -> None:
    system = start(lease_s=2.0)
    system.until(system.services.index.overview.workers, "the worker is listed")
    (first,) = system.services.index.overview.workers()
    seen: set[str] = set()

    def is_gone() -> bool:
        now = system.services.index.overview.workers()
        seen.update(worker.state for worker in now)
        return first.name not in {worker.name for worker in now}

    os.kill(system.supervisor.pids["worker-0"], signal.SIGTERM)
    system.until(is_gone, "it is no longer listed")
    assert "lost" not in seen
    system.until(system.services.index.overview.workers, "its successor is listed")
    system.kill("worker-0")
    system.until(lambda: is_gone() and "lost" in seen, "it is lost")


def test_somebody_at_a_screen_does_not_wait_for_a_dataset(start: Start) -> None:
    system = start(workers=2, environment={"FAKE_SECONDS": "0.3"})
    bulk = job_actions.submit(system.services, request(grasps=100_000), priority=Priority.BULK)[0].id
    system.until(lambda: system.services.index.jobs.get(bulk).grasps, "the dataset runs")
    system.hold.touch()
    system.until(lambda: len(system.services.queue.waiting_tasks()) >= _WAITING, "the dataset fills the queue")
    job = system.submit(request(grasps=32, seed=1))
    (task,) = system.services.index.jobs.tasks(job=job).items
    system.until(lambda: task.id in system.services.queue.waiting_tasks(), "the small job waits too")
    released = timestamp()
    system.hold.unlink()
    (done,) = system.finish(job)
    assert system.services.index.jobs.get(bulk).state is State.RUNNING
    batches = system.services.index.jobs.tasks(job=bulk, state=State.SUCCEEDED, limit=200).items
    between = [task for task in batches if released < (task.finished or "") < (done.finished or "")]
    assert len(between) <= _BEFORE_IT, f"of {_WAITING} batches that waited before it, {len(between)} went first"


def test_a_worker_whose_engine_breaks_returns_when_it_is_fixed(start: Start, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    system = start(api=True, environment={"FAKE_BROKEN": str(broken)})
    system.finish(system.submit(request(seed=1)))
    broken.touch()
    jobs = [system.submit(request(seed=seed)) for seed in (2, 3)]
    url = f"{system.supervisor.api_url}/v1/workers"
    found: list[dict[str, str]] = []

    def is_shown() -> bool:
        found[:] = [worker for worker in httpx.get(url, timeout=60).json() if worker["state"] == "quarantined"]
        return bool(found)

    system.until(is_shown, "the worker is shown in quarantine")
    assert found[0]["reason"] == "no kernel can be loaded"
    page = httpx.get(f"{system.supervisor.api_url}/workers", timeout=60).text
    assert "takes no tasks: no kernel can be loaded" in page
    broken.unlink()
    done = system.finish(*jobs)
    assert {job.state for job in done} == {State.SUCCEEDED}
    assert system.services.index.jobs.attempts() == [], "it cost no attempt"


@pytest.fixture
def own_s3(s3_server: S3Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Server]:
    with S3Server() as server:
        for name, value in server.environment.items():
            monkeypatch.setenv(name, value)
        yield server


@pytest.fixture
def own_postgres(postgres_server: PostgresServer) -> Iterator[PostgresServer]:
    with PostgresServer() as server:
        yield server


def messages(system: System, job: str) -> list[str]:
    return [task.message or "" for task in system.services.index.jobs.tasks(job=job, limit=200).items]


def finish_and_compare(system: System, job: str, grasps: int) -> None:
    (done,) = system.finish(job)
    assert (done.state, done.grasps) == (State.SUCCEEDED, grasps)
    assert system.services.index.jobs.attempts(job=job) == [], "it costs no attempt"
    system.until(lambda: not differences(system.services.index, system.services.store), "index and store agree")


@pytest.mark.s3
def test_a_store_killed_in_the_middle_is_waited_for(start: Start, own_s3: S3Server) -> None:
    system = start(workers=2, environment={"FAKE_SECONDS": "0.2"}, store_url=own_s3.url, retry_backoff_s=0.2)
    system.finish(system.submit(request(seed=1)))
    system.hold.touch()
    job = system.submit(request(grasps=32 * 20))
    system.until(lambda: system.services.index.jobs.get(job).state is State.RUNNING, "a task of it runs")
    own_s3.kill()
    system.hold.unlink()
    system.until(lambda: any(m.startswith("waits: the store") for m in messages(system, job)), "tasks say so")
    assert not system.services.index.jobs.get(job).state.is_final
    own_s3.start()
    finish_and_compare(system, job, 32 * 20)


@pytest.mark.postgres
def test_an_index_killed_in_the_middle_is_caught_up_with(start: Start, own_postgres: PostgresServer) -> None:
    system = start(index_url=own_postgres.database())
    system.finish(system.submit(request(seed=1)))
    system.hold.touch()
    job = system.submit(request(grasps=32 * 20))
    system.until(lambda: len(system.services.queue.waiting_tasks()) >= 4, "more waits than the one that runs")
    own_postgres.kill()
    made = len(list(system.services.store.list("shards")))
    system.hold.unlink()
    system.until(lambda: len(list(system.services.store.list("shards"))) > made + 4, "workers go on without it")
    own_postgres.start()
    finish_and_compare(system, job, 32 * 20)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 2.8 MB, 0.4 MB more than the built-in assets take."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2800k", "tmpfs", str(folder)]
    if os.getuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("only root may mount a small file system")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_a_full_disk_is_waited_for_until_there_is_room(start: Start, small_disk: Path) -> None:
    system = start(store_url=(small_disk / "store").as_uri(), retry_backoff_s=0.2)
    job = system.submit(request(grasps=32 * 100))
    says = "No space left on device"
    system.until(lambda: any(says in message for message in messages(system, job)), "a task says so")
    time.sleep(1.0)  # some more candidates
    assert not system.services.index.jobs.get(job).state.is_final
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    finish_and_compare(system, job, 32 * 100)


class House:
    """Redis, controllers and a worker as processes, each with a log. While there is a file `hold` no task ends."""

    def __init__(self, folder: Path) -> None:
        self.settings = Settings(data_dir=folder / "data", lease_s=LEASE_S, controller_interval_s=0.3, task_s=0.0)
        self._logs = folder / "logs"
        self._logs.mkdir()
        self.hold = folder / "hold"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.start("redis", *server_command(self.settings))
        empty_index(self.settings.resolved_index_url).close()
        self.services = Services.open(self.settings)
        wait_for_redis(self.services.queue)
        add_assets(self.services)

    def start(self, name: str, *command: str, **more: str) -> None:
        environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "FAKE_HOLD": str(self.hold)}
        environment |= {"GRASPD_DATA_DIR": str(self.settings.data_dir), "GRASPD_REDIS_URL": redis_url(self.settings)}
        environment |= {"GRASPD_LEASE_S": str(LEASE_S), "GRASPD_CONTROLLER_INTERVAL_S": "0.3", "GRASPD_TASK_S": "0"}
        environment |= {"GRASPD_LOG_FORMAT": "text", **more}
        with (self._logs / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(command, env=environment, stdout=log, stderr=log)

    def controller(self, name: str, **more: str) -> None:
        self.start(name, sys.executable, "-m", "graspd", "controller", **more)

    def says(self, name: str, what: str) -> int:
        return len(re.findall(what, (self._logs / f"{name}.log").read_text()))

    def until(self, met: Callable[[], object], what: str) -> None:
        until(met, what, logs=self._said)

    def done(self, job: str) -> int:
        return len(self.services.index.jobs.tasks(job=job, state=State.SUCCEEDED, limit=100).items)

    def _said(self) -> str:
        return "\n".join(f"--- {file.name}\n{file.read_text()[-1500:]}" for file in sorted(self._logs.iterdir()))

    def close(self) -> None:
        self.services.close()
        for name in reversed(self.processes):
            process = self.processes[name]
            process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    made = House(tmp_path)
    yield made
    made.close()


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
def test_one_that_is_started_again_under_its_name_need_not_wait(house: House) -> None:
    house.controller("first", GRASPD_CONTROLLER_NAME="node-1", GRASPD_LEASE_S="600")
    house.until(lambda: house.says("first", "this controller leads"), "the first leads")
    house.processes["first"].kill()
    house.processes["first"].wait()
    house.controller("again", GRASPD_CONTROLLER_NAME="node-1", GRASPD_LEASE_S="600")
    house.until(lambda: house.says("again", "this controller leads"), "it leads again")


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
