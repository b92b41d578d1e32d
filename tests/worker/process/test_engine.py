"""A worker, its registration, the engine beside it, and queued tasks: forged, without a lease, or refused by Redis."""

import logging
import os
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import pytest
from rq import Queue
from rq.serializers import JSONSerializer

from graspd.service.model.messages import TaskMessage
from graspd.service.model.states import Priority, Stage
from graspd.service.queue.port import EventKind
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.settings import Settings
from graspd.service.store.manifests import load_manifest
from graspd.service.store.records import task_attempts
from graspd.service.store.store import open_store
from graspd.worker.engines.devices import Device
from graspd.worker.process import engine, main
from graspd.worker.process.engine import Engine, TaskResources
from graspd.worker.process.heartbeat import Heartbeat
from graspd.worker.process.link import EngineLost, Link, Setup, is_stopped
from graspd.worker.process.main import GraspWorker, run_worker
from graspd.worker.process.runner import Runner
from graspd.worker.process.task_log import LINE_CHARACTERS, LINES
from graspd.worker.stages.context import StopReason, TaskContext
from tests.fakes import beat_of, engine_of, fake_synthesize, message_for
from tests.memory_queue import events_after
from tests.waiting import until
from tests.worker.pool import works
from tests.worker.process.test_runner import broken

LEASE_S = 2.0
TASK = message_for()


@dataclass
class Worker:
    """A worker's process and what Redis shows of it."""

    process: subprocess.Popen[bytes]
    queue: RqQueue

    @property
    def engine(self) -> int:
        pid = self.process.pid
        (child,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        return int(child)

    def events(self) -> list[EventKind]:
        return [event.kind for _, event in events_after(self.queue)]

    def states(self) -> list[str]:
        return [beat.state for beat in self.queue.workers()]

    def begin(self) -> None:
        self.queue.enqueue([TASK], Priority.BULK)
        until(lambda: EventKind.STARTED in self.events(), "the task began")


Start = Callable[..., Worker]


@pytest.fixture
def start(rq_queue: RqQueue, redis_server: str, tmp_path: Path) -> Iterator[Start]:
    """Starts a worker; by itself it goes on with its task until there is no file `hold`."""
    started: list[subprocess.Popen[bytes]] = []
    (tmp_path / "hold").touch()

    def start(environment: Mapping[str, str] | None = None, *, state: str = "idle") -> Worker:
        settings = {"REDIS_URL": redis_server, "DATA_DIR": str(tmp_path), "DEVICE": "cpu", "LEASE_S": str(LEASE_S)}
        own = {f"GRASPD_{name}": value for name, value in settings.items()}
        fake = {"FAKE_HOLD": str(tmp_path / "hold"), **(environment or {})}
        started.append(subprocess.Popen([sys.executable, "-m", "tests.fakes"], env={**os.environ, **own, **fake}))
        worker = Worker(started[-1], rq_queue)
        until(lambda: worker.states() == [state], f"it is {state}")
        return worker

    yield start
    for process in started:
        process.kill()
        process.wait()


def test_a_cancelled_task_stops(start: Start) -> None:
    worker = start()
    worker.begin()
    worker.queue.discard([TASK.task_id])
    until(lambda: worker.events()[-1:] == [EventKind.CANCELLED], "it stops")
    assert worker.queue.leases() == []
    until(lambda: worker.states() == ["idle"], "its worker takes the next one")


def test_a_lease_that_was_taken_is_not_made_again(start: Start) -> None:
    worker = start()
    worker.begin()
    (lease,) = worker.queue.leases()
    worker.queue.release(lease)
    until(lambda: worker.states() == ["idle"], "the task stops")
    assert worker.queue.leases() == [] and worker.events()[-1] is EventKind.STARTED, "it is another's now"
    left = [key for key in worker.queue.connection.keys("*") if TASK.task_id.encode() in key]
    assert left == [f"graspd:log:{TASK.task_id}-1".encode()]


def test_a_lease_is_kept_while_the_engine_lets_nothing_else_run(start: Start) -> None:
    worker = start({"FAKE_LOCK_S": str(4 * LEASE_S)})
    worker.begin()
    (first,) = worker.queue.leases()
    seen = {first.beat}

    def beats() -> bool:
        seen.update(lease.beat for lease in worker.queue.leases())
        return len(seen) > 3

    until(beats, "its lease is renewed")
    assert worker.states() == ["busy"]


def test_a_worker_that_was_stopped_by_a_signal_falls_silent(start: Start) -> None:
    worker = start()
    worker.process.send_signal(signal.SIGSTOP)
    until(lambda: worker.states() == [], "its registration ends")
    worker.process.send_signal(signal.SIGCONT)
    until(worker.states, "it gives signs of life again")


def test_a_worker_whose_engine_was_stopped_keeps_no_lease(start: Start) -> None:
    worker = start()
    worker.begin()
    os.kill(worker.engine, signal.SIGSTOP)
    until(lambda: worker.states() == [], "its registration ends")
    (lease,) = worker.queue.leases()
    worker.queue.release(lease)
    os.kill(worker.engine, signal.SIGCONT)
    until(lambda: worker.states() == ["idle"], "it hears that the task is another's")


def test_no_engine_outlives_its_worker(start: Start) -> None:
    worker = start()
    worker.begin()
    pid = worker.engine
    worker.process.kill()
    worker.process.wait()
    until(lambda: is_stopped(pid), "the engine ended")
    assert worker.queue.leases(), "the controller finds the lease"


def test_a_worker_ends_with_its_engine_and_leaves_the_lease_to_the_controller(start: Start) -> None:
    worker = start()
    worker.begin()
    os.kill(worker.engine, signal.SIGKILL)
    assert worker.process.wait(60) == 1 and worker.queue.leases() and worker.events() == [EventKind.STARTED]


@pytest.mark.parametrize("which", ["engine", "worker"])
def test_a_worker_in_quarantine_leaves_when_it_or_its_engine_ends(start: Start, tmp_path: Path, which: str) -> None:
    (broken := tmp_path / "broken").touch()
    worker = start({"FAKE_BROKEN": str(broken)}, state="quarantined")
    worker.queue.enqueue([TASK], Priority.BULK)
    pid = worker.engine
    if which == "engine":
        os.kill(pid, signal.SIGKILL)
    else:
        worker.process.send_signal(signal.SIGTERM)
    assert worker.process.wait(60) == (1 if which == "engine" else 0)
    assert worker.events() == [EventKind.LEFT] and worker.states() == [] and is_stopped(pid)


class Deaf(Link):
    def __init__(self) -> None:
        self.told = []
        self.killed = False

    def send(self, word: str, about=None) -> None:
        self.told.append(about)

    def receive(self, wait_s: float) -> None:
        if self.killed:
            raise EngineLost("killed")

    def kill(self) -> None:
        self.killed = True


def test_an_engine_with_too_long_a_task_is_stopped_then_ended(rq_queue, redis_server, monkeypatch) -> None:
    monkeypatch.setattr(main, "STUCK_AFTER_S", 0.2)
    deaf = Deaf()
    heart = Heartbeat(redis_server, beat_of(), lease_s=LEASE_S)
    worker = GraspWorker(rq_queue, deaf, heart, stages=[TASK.stage], name="w", limit_s=0.2)
    with pytest.raises(EngineLost):
        worker.admit()
    assert deaf.told == [None, StopReason.TIMEOUT] and deaf.killed


def test_the_first_reason_to_stop_stands() -> None:
    context = TaskContext(None)
    context.stop(StopReason.SHUTDOWN)
    context.stop(StopReason.LEASE_LOST)
    assert context.stop_reason is StopReason.SHUTDOWN


def test_half_an_order_does_not_break_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", broken.append)
    ours, theirs = Pipe()
    settings = Settings(data_dir=tmp_path, store_url=f"file://{tmp_path}/store", device="cuda:99")
    header = struct.pack("!i", 1)
    os.write(ours.fileno(), header[:2])
    Engine(theirs, Setup(settings, tuple(Stage), "a-worker", patient=False)).serve()
    assert ours.recv()[0] == "refused"
    with suppress(BrokenPipeError):  # where the engine closed its end before it went on reading
        os.write(ours.fileno(), header[2:])
    until(lambda: "engine-orders" not in {thread.name for thread in threading.enumerate()}, "its listener ends")
    assert not broken, broken[0].exc_value


def resources(folder: Path, processes: int) -> TaskResources:
    settings = Settings(data_dir=folder, processes=processes)
    return TaskResources(settings, open_store("memory://"), Device("cpu"))


def test_tasks_that_make_grasps_share_processes_of_their_worker(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(engine, "MODULES", ())  # these need none of the engine
    worker = resources(tmp_path, 2)
    try:
        assert [worker.pool(stage) for stage in Stage if stage is not Stage.SYNTHESIZE] == [None] * (len(Stage) - 1)
        pool = worker.pool(Stage.SYNTHESIZE)
        assert pool is worker.pool(Stage.SYNTHESIZE) and pool.processes == 2
        assert pool.map(works.times, "three", 3, [1, 2]) == [3, 6]
    finally:
        worker.close()
    assert resources(tmp_path, 1).pool(Stage.SYNTHESIZE) is None
    assert resources(tmp_path, 0).pool(Stage.SYNTHESIZE) is None, "on a CPU threads do it, where nobody says otherwise"


@pytest.fixture
def heart(rq_queue: RqQueue, redis_server: str, tmp_path: Path) -> Iterator[Heartbeat]:
    heart = Heartbeat(redis_server, beat_of(), lease_s=LEASE_S, alive=tmp_path / "alive")
    heart.start()
    until(rq_queue.workers, "the first beat")
    yield heart
    heart.stop()


def test_what_a_worker_is_at_is_shown_at_once(heart: Heartbeat, rq_queue: RqQueue, tmp_path: Path) -> None:
    until((tmp_path / "alive").exists, "its file is touched")
    heart.interval_s = 3600.0
    heart.update(state="busy", task_id="a")
    until(lambda: [(beat.state, beat.task_id) for beat in rq_queue.workers()] == [("busy", "a")], "the news")
    heart.update(done=1.0, total=4.0, message="descending")
    told = ("a", 1.0, 4.0, "descending")
    until(lambda: [(b.task_id, b.done, b.total, b.message) for b in rq_queue.workers()] == [told], "how far it is")


def test_a_worker_that_leaves_is_not_lost(heart: Heartbeat, rq_queue: RqQueue) -> None:
    heart.stop()
    assert rq_queue.workers() == []
    assert [event.kind for _, event in events_after(rq_queue)] == [EventKind.LEFT]


def test_it_goes_on_when_redis_answers_again(heart: Heartbeat, rq_queue: RqQueue) -> None:
    rq_queue.connection.config_set("min-replicas-to-write", 1)
    try:
        until(lambda: rq_queue.workers() == [], "its registration ends")
    finally:
        rq_queue.connection.config_set("min-replicas-to-write", 0)
    until(rq_queue.workers, "it gives signs of life again")


@pytest.fixture
def work(rq_queue, redis_server: str, tmp_path):
    settings = Settings(redis_url=redis_server, data_dir=tmp_path, device="cpu")

    def run(table, **options) -> bool:
        return run_worker(settings, start=engine_of(table), **{"burst": True} | options)

    return run


@pytest.fixture
def kinds(rq_queue):
    return lambda: [event.kind for _, event in events_after(rq_queue)]


def _waits(redis: Any, entry: str | bytes) -> None:
    redis.rpush("rq:queue:bulk-synthesize", entry)


def _job(redis: Any, function: str, *arguments: Any) -> str:
    queue = Queue("bulk-synthesize", connection=redis, serializer=JSONSerializer)
    return str(queue.enqueue_call(function, args=arguments).id)


def test_a_task_leaves_its_log_where_it_is_read(rq_queue: RqQueue, work: Any, tmp_path: Path) -> None:
    message, seen = message_for(), []

    def stage(task: TaskMessage, context: TaskContext):
        for n in range(2 * LINES):
            logging.getLogger("graspd.worker").info("line %d of redis://user:hunter2@host and %s", n, "x" * 999)
        context.progress(1, 4, "descending")
        until(lambda: seen.append(rq_queue.task_log(f"{message.task_id}-1")) or seen[-1], "the log of a running task")
        return fake_synthesize(task, context)

    logging.getLogger().setLevel(logging.INFO)
    rq_queue.enqueue([message], Priority.BULK)
    assert work({Stage.SYNTHESIZE: stage})
    store = open_store(Settings(data_dir=tmp_path).resolved_store_url)
    kept = load_manifest(store, message.stage, message.output).info["log"]
    whole = rq_queue.task_log(f"{message.task_id}-1")
    assert kept.splitlines()[-2:] == whole.splitlines()[-3:-1], "the line of the runner's end comes after it"
    assert "25% descending" in kept and "computed in" in kept
    assert len(kept.splitlines()) == LINES and max(map(len, kept.splitlines())) <= LINE_CHARACTERS
    assert "hunter2" not in f"{seen}{kept}{whole}" and "***@host" in kept
    assert rq_queue.connection.ttl(f"graspd:log:{message.task_id}-1") > 0


def test_a_failed_attempt_keeps_its_log(rq_queue: RqQueue, work: Any, tmp_path: Path) -> None:
    def stage(task: TaskMessage, context: TaskContext):
        logging.getLogger("graspd.worker").warning("about to break")
        raise ValueError("it broke")

    rq_queue.enqueue([TASK], Priority.BULK)
    assert work({Stage.SYNTHESIZE: stage})
    (attempt,) = task_attempts(open_store(Settings(data_dir=tmp_path).resolved_store_url), TASK.task_id)
    assert "WARNING graspd.worker about to break" in attempt.log
    assert attempt.log.splitlines()[-1] == "ValueError: it broke"


FORGERIES: dict[str, Callable[[Any, Path], object]] = {
    "a name that is no text": lambda redis, _: _waits(redis, b"\xff"),
    "a name with blanks": lambda redis, _: _waits(redis, "a b"),
    "an attempt of 5,000 digits": lambda redis, _: _waits(redis, "a-" + "9" * 5000),
    "a string in the place of a job": lambda redis, _: (redis.set("rq:job:X", "x"), _waits(redis, "X")),
    "a job of no time": lambda redis, _: redis.hset(f"rq:job:{_job(redis, 'os.getcwd')}", "created_at", "yesterday"),
    "a job of no data": lambda redis, _: redis.hset(f"rq:job:{_job(redis, 'os.getcwd')}", "data", b"\xff\xfe"),
    "a command": lambda redis, witness: _job(redis, "os.system", f"touch {witness}"),
    "another function of ours": lambda redis, _: _job(redis, "graspd.service.queue.entries.run_task", {}),
    "a task without a message": lambda redis, _: _job(redis, "graspd.task", "text"),
    "a message of nothing": lambda redis, _: _job(redis, "graspd.task", {}),
}


@pytest.mark.parametrize("what", FORGERIES)
def test_what_is_no_task_is_passed_over(rq_queue, work: Any, kinds: Any, tmp_path: Path, what: str) -> None:
    witness = tmp_path / "witness"
    FORGERIES[what](rq_queue.connection, witness)
    rq_queue.enqueue([message_for()], Priority.BULK)
    assert work({Stage.SYNTHESIZE: fake_synthesize}), "the worker is none the worse"
    assert kinds()[:2] == [EventKind.STARTED, EventKind.FINISHED], "the task behind it is done"
    assert not witness.exists() and rq_queue.leases() == []


def test_a_task_that_was_taken_away_ends_in_a_line_and_no_traceback(rq_queue, work, caplog) -> None:
    def slow(message: TaskMessage, context: TaskContext):
        (lease,) = rq_queue.leases()
        rq_queue.release(lease)
        return fake_synthesize(message, TaskContext(context.store))

    rq_queue.enqueue([message_for()], Priority.BULK)
    with caplog.at_level(logging.INFO):
        assert work({Stage.SYNTHESIZE: slow})
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING] == []
    assert [record for record in caplog.records if "was taken from this worker" in record.getMessage()]
    assert not rq_queue.connection.keys("rq:job:*"), "nothing is left of it"


def test_a_worker_that_an_error_broke_off_has_work_left(rq_queue, work, monkeypatch) -> None:
    """Batch scripts start it again then; where none waits any more, they end."""
    table = {Stage.SYNTHESIZE: fake_synthesize}
    assert work(table), "none waits"

    def broken(*_: object) -> None:
        raise AttributeError("of another version")

    rq_queue.enqueue([message_for()], Priority.BULK)
    with monkeypatch.context() as patch:
        patch.setattr(GraspWorker, "prepare_execution", broken)
        assert not work(table)
    rq_queue.connection.flushdb()
    rq_queue.enqueue([message_for()], Priority.BULK)
    assert work(table, burst=False, max_tasks=1), "as many as were wanted"


def test_the_end_of_a_task_waits_until_redis_takes_writes(rq_queue, work, kinds) -> None:
    """Redis refuses writes here for want of replicas, as it does on a full disk."""

    def refuse(replicas: int) -> None:
        rq_queue.connection.config_set("min-replicas-to-write", replicas)

    def stage(message: TaskMessage, context: TaskContext):
        until(lambda: events_after(rq_queue), "it was told that the task began")
        refuse(1)
        threading.Timer(1.0, refuse, [0]).start()
        return fake_synthesize(message, context)

    rq_queue.enqueue([message_for()], Priority.BULK)
    try:
        assert work({Stage.SYNTHESIZE: stage})
    finally:
        refuse(0)
    assert rq_queue.leases() == [] and not rq_queue.connection.keys("rq:job:*")
    assert kinds()[:2] == [EventKind.STARTED, EventKind.FINISHED]


def test_the_worker_ends_and_leaves_the_other_tasks(rq_queue, work, kinds, tmp_path, monkeypatch, caplog) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(engine, "Runner", partial(Runner, check_device=broken))
    rq_queue.enqueue([message_for(), message_for(seed=1)], Priority.BULK)
    with caplog.at_level(logging.ERROR):
        assert not work({Stage.SYNTHESIZE: fake_synthesize}, burst=False), "its supervisor should know"
    assert kinds()[:2] == [EventKind.STARTED, EventKind.RETURNED] and kinds().count(EventKind.STARTED) == 1
    assert rq_queue.leases() == []
    assert any(line.startswith("this worker ends: CUDA error 700") for line in caplog.messages)
