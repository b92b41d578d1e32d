"""Runs of tasks and how they end; which failures are the worker's own, and its check of itself."""

from collections.abc import Collection
from pathlib import Path

import pytest

from graspd.service.model import names
from graspd.service.model.errors import (
    DamagedError,
    InputError,
    MeshError,
    QueueUnavailable,
    StoreUnavailable,
    TaskRefused,
)
from graspd.service.model.messages import TaskMessage
from graspd.service.model.states import Stage
from graspd.service.queue.port import Event, EventKind
from graspd.service.store.manifests import load_manifest, shard_exists
from graspd.service.store.records import task_attempts
from graspd.service.store.shards import read_shard
from graspd.service.store.store import Store, open_store
from graspd.worker import generation
from graspd.worker.engines.devices import DeviceLost
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.pool.pool import ProcessLost
from graspd.worker.process import fitness as module
from graspd.worker.process.fitness import Fitness
from graspd.worker.process.runner import Runner
from graspd.worker.process.selfcheck import EngineError, check_engine
from graspd.worker.stages import scene
from graspd.worker.stages.context import StopReason, TaskContext
from tests.damage import flip
from tests.fakes import fake_synthesize, make_shard, message_for


class Bench:
    """A runner on a store in memory."""

    runner: Runner

    def __init__(self, **options) -> None:
        self.store: Store = open_store("memory://")
        self.told: list[Event] = []
        self.calls = 0
        self.options = options

    def run(self, message: TaskMessage, stage=fake_synthesize, **changes) -> Event | None:
        def counted(task: TaskMessage, context: TaskContext):
            self.calls += 1
            return stage(task, context)

        self.runner = Runner({Stage.SYNTHESIZE: counted}, worker="w", publish=self.told.append, **self.options)
        context = TaskContext(self.store, ExecutionContext("cuda:0" if "check_device" in self.options else "cpu"))
        return self.runner.run(message.model_dump(mode="json", by_alias=True) | changes, context)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def raising(error: Exception):
    def stage(message: TaskMessage, context: TaskContext) -> None:
        raise error

    return stage


def test_a_task_leaves_a_shard_with_its_manifest_and_is_not_done_again(bench: Bench) -> None:
    message = message_for()
    outcome = bench.run(message)
    assert (outcome.kind, outcome.output) == (EventKind.FINISHED, message.output)
    assert [event.kind for event in bench.told] == [EventKind.STARTED]
    manifest = load_manifest(bench.store, Stage.SYNTHESIZE, message.output)
    shard = read_shard(bench.store.get(manifest.key), kind="base")
    assert manifest.counts["N"] == len(manifest.grasps) == 32 and manifest.valid == shard["quality/valid"].sum()
    assert manifest.index_threshold_m == 0.005
    assert [g.epsilon for g in manifest.grasps] == list(shard["quality/epsilon"][:, 1])
    assert all(g.stability_loss is None for g in manifest.grasps), "nan is no JSON number"
    assert shard.attributes["hand"] == "gripper"
    assert bench.run(message, raising(AssertionError("it ran"))).kind is EventKind.FINISHED and bench.calls == 1


def test_a_shard_left_without_its_manifest_is_described_as_it_is(bench: Bench) -> None:
    message = message_for()
    first = make_shard(bench.store, message, worker="first")
    other = open_store("memory://")
    other.put(first.key, bench.store.get(first.key))
    bench.store = other

    def different(task: TaskMessage, context: TaskContext):
        return fake_synthesize(task.model_copy(update={"batch": 9}), context)

    bench.run(message, different)
    manifest = load_manifest(other, Stage.SYNTHESIZE, message.output)
    assert (manifest.sha256, manifest.grasps, manifest.valid) == (first.sha256, first.grasps, first.valid)


def test_an_error_is_recorded_with_its_trace(bench: Bench) -> None:
    message = message_for()
    outcome = bench.run(message, raising(ValueError("no\nway")))
    assert (outcome.kind, outcome.message) == (EventKind.FAILED, "no way")
    (attempt,) = task_attempts(bench.store, message.task_id)
    assert (attempt.number, attempt.kind, attempt.reason, attempt.worker) == (1, "ValueError", "no way", "w")
    assert "raise error" in attempt.trace


@pytest.mark.parametrize(
    ("error", "attempt", "last"),
    [
        (ValueError("no"), 1, False),
        (ValueError("no"), 3, True),
        (InputError("bad"), 1, True),
        (MeshError("torn"), 1, True),
        (TaskRefused("unknown"), 1, True),
    ],
)
def test_bad_input_and_last_attempts_are_final(bench: Bench, error: Exception, attempt: int, last: bool) -> None:
    outcome = bench.run(message_for(attempt=attempt), raising(error))
    assert (outcome.kind, outcome.last) == (EventKind.FAILED, last)


def full_disk(message: TaskMessage, context: TaskContext) -> None:
    try:
        Path("/dev/full").write_text("a kernel, a picture")
    except OSError as error:
        raise RuntimeError("no file could be written") from error


@pytest.mark.parametrize(
    ("stage", "said"),
    [
        (raising(StoreUnavailable("full")), "full"),
        (raising(QueueUnavailable("away")), "away"),
        (full_disk, "No space left on device: no file could be written"),
    ],
)
def test_a_part_that_is_away_or_full_costs_no_attempt(bench: Bench, stage, said: str) -> None:
    message = message_for(attempt=3)
    outcome = bench.run(message, stage)
    assert (outcome.kind, outcome.message) == (EventKind.DEFERRED, said)
    assert task_attempts(bench.store, message.task_id) == []


def test_a_failure_that_cannot_be_recorded_is_deferred(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(key: str, data: bytes) -> bool:
        raise StoreUnavailable("the store is full")

    monkeypatch.setattr(bench.store, "put", full)
    outcome = bench.run(message_for(), raising(ValueError("no")))
    assert outcome.kind is EventKind.DEFERRED and "the store is full" in outcome.message


@pytest.mark.parametrize(
    ("reason", "kind"),
    [
        (StopReason.CANCELLED, EventKind.CANCELLED),
        (StopReason.SHUTDOWN, EventKind.RETURNED),
        (StopReason.LEASE_LOST, None),
        (StopReason.TIMEOUT, EventKind.FAILED),
    ],
)
def test_why_a_task_was_stopped_decides_what_is_told(bench: Bench, reason: StopReason, kind: EventKind | None) -> None:
    def stopping(message: TaskMessage, context: TaskContext):
        context.stop(reason)
        context.check()

    message = message_for()
    outcome = bench.run(message, stopping)
    assert (outcome.kind if outcome else None) is kind
    assert len(task_attempts(bench.store, message.task_id)) == (kind is EventKind.FAILED)


def test_a_stage_that_ignores_the_stop_still_writes_nothing(bench: Bench) -> None:
    def deaf(message: TaskMessage, context: TaskContext):
        context.stop(StopReason.CANCELLED)
        return fake_synthesize(message, TaskContext(context.store))

    message = message_for()
    assert bench.run(message, deaf).kind is EventKind.CANCELLED
    assert not bench.store.exists(names.shard_file_key(Stage.SYNTHESIZE, message.output))


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"schema": 99, "newest_schema": 99, "something_new": True}, "schema 99"),
        ({"schema": 1, "newest_schema": 1}, "schema 1"),
        ({"revision": 99}, "revision 99 of synthesize"),
    ],
)
def test_what_another_version_must_do_costs_no_attempt(bench: Bench, changed: dict, why: str) -> None:
    message = message_for()
    outcome = bench.run(message, **changed)
    assert outcome.kind is EventKind.DEFERRED and why in outcome.message and bench.calls == 0
    assert task_attempts(bench.store, message.task_id) == []


@pytest.mark.parametrize(
    "forged",
    [
        {"count": "many"},
        {"output": "../../etc/passwd"},
        {"scene": "moon"},
        {"scene": {"supports": [{"kind": "mesh", "file": "/etc/passwd"}]}},
        {"scene": {"supports": [{"kind": "box", "size": [1e300, 1, 1]}]}},
        {"scene": {"supports": [{"kind": "half_space"}] * 100_000}},
    ],
    ids=["number", "path", "scene", "file", "size", "many"],
)
def test_what_is_no_message_is_refused(bench: Bench, forged: dict) -> None:
    message = message_for(scene="table")
    if "scene" in forged:
        forged = {"request": message.request.model_dump(mode="json") | forged}
    with pytest.raises(TaskRefused, match="no task of graspd"):
        bench.run(message, **forged)
    assert bench.calls == 0


def test_a_stage_that_is_not_served_here_is_refused(bench: Bench) -> None:
    outcome = bench.run(message_for(Stage.SCENE, scenes=1))
    assert (outcome.kind, outcome.last) == (EventKind.FAILED, True)


def test_progress_of_a_part_is_told_as_its_share_and_only_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.worker.stages.context.REPORT_EVERY_S", 3600.0)
    told: list[tuple[float, float, str]] = []
    context = TaskContext(open_store("memory://"), tell=lambda *args: told.append(args))
    for step in range(1, 10_000):
        context.run.with_progress_range(0.8, 1.0).progress(step, 2, "quality")
    assert told == [(pytest.approx(0.9), 1.0, "quality")]


def test_a_stage_refuses_a_damaged_shard_and_is_not_tried_again(bench: Bench) -> None:
    base = make_shard(bench.store, message_for(scenes=1))
    message = message_for(Stage.SCENE, scenes=1)
    assert message.inputs == (base.shard_id,)
    flip(bench.store, base.key)
    runner = Runner({Stage.SCENE: scene.run}, worker="w", publish=bench.told.append)
    outcome = runner.run(message.model_dump(mode="json", by_alias=True), TaskContext(bench.store))
    (attempt,) = task_attempts(bench.store, message.task_id)
    assert (outcome.kind, attempt.kind, attempt.last) == (EventKind.FAILED, "DamagedShard", True)
    assert base.shard_id in attempt.reason


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def broken(device: str) -> None:
    raise DeviceLost("CUDA error 700 on cuda:0: nothing runs there any more in this process")


#: What a stage meets whose numbers no kernel has written.
GARBLED = raising(ArithmeticError("not a number"))


@pytest.mark.parametrize("stage", [fake_synthesize, GARBLED])
def test_the_task_goes_back_without_a_result_or_an_attempt(stage) -> None:
    bench, message = Bench(check_device=broken), message_for()
    event = bench.run(message, stage)
    assert event.kind is EventKind.RETURNED
    assert "CUDA error 700" in event.message and "CUDA error 700" in bench.runner.device_lost
    assert not shard_exists(bench.store, message.stage, message.output)
    assert not list(task_attempts(bench.store, message.task_id))


def test_a_task_that_takes_down_one_gpu_after_the_other_uses_up_its_attempts() -> None:
    bench, message = Bench(check_device=broken), message_for()
    bench.run(message)
    assert bench.run(message).kind is EventKind.FAILED
    (attempt,) = task_attempts(bench.store, message.task_id)
    assert (attempt.kind, attempt.last) == ("DeviceLost", False)


def test_a_task_over_which_a_process_beside_the_worker_ended_goes_back_once_and_the_worker_goes_on() -> None:
    bench, message = Bench(check_device=lambda device: None), message_for()
    lost = raising(ProcessLost("a process of the pool ended during its work (signal 9)"))
    event = bench.run(message, lost)
    assert (event.kind, bench.runner.device_lost) == (EventKind.RETURNED, "")
    assert "signal 9" in event.message and not list(task_attempts(bench.store, message.task_id))
    assert bench.run(message, lost).kind is EventKind.FAILED, "a task that ends each must use up its attempts"


def test_a_device_that_works_is_not_blamed() -> None:
    bench = Bench(check_device=lambda device: None)
    assert (bench.run(message_for(), GARBLED).kind, bench.runner.device_lost) == (EventKind.FAILED, "")


class Doubted(Bench):
    """A runner whose engine can be broken_engine."""

    def __init__(self) -> None:
        super().__init__()
        self.engine_works = True
        self.checked: list[tuple[Stage, ...]] = []
        self.states: list[dict[str, str]] = []
        self.options["fitness"] = self.fitness = Fitness(self.store, self._check)

    def _check(self, stages: Collection[Stage]) -> None:
        self.checked.append(tuple(stages))
        if not self.engine_works:
            raise EngineError("synthesize: ImportError: libcuda.so.1")

    def sits_out(self, told_to_stop: bool = False) -> bool:
        return self.fitness.wait_in_quarantine((Stage.SYNTHESIZE,), self._tell, lambda: told_to_stop)

    def _tell(self, **facts: str) -> None:
        self.states.append(facts)

    def fail(self, seed: int) -> Event:
        message = message_for(seed=seed).model_copy(update={"task_id": f"{seed:032x}"})
        return self.run(message, raising(RuntimeError("no result")))


@pytest.fixture
def doubted(monkeypatch: pytest.MonkeyPatch) -> Doubted:
    monkeypatch.setattr(module, "PAUSES_S", (0.0, 0.0))
    return Doubted()


def test_a_task_that_failed_because_the_engine_broke_goes_back_without_an_attempt(doubted: Doubted) -> None:
    doubted.engine_works = False
    event = doubted.fail(1)
    assert (event.kind, event.message) == (EventKind.RETURNED, "synthesize: ImportError: libcuda.so.1")
    assert task_attempts(doubted.store, event.task_id) == []
    assert doubted.fitness.reason == event.message


def test_a_task_that_fails_with_a_sound_engine_has_failed(doubted: Doubted) -> None:
    assert doubted.fail(1).kind is EventKind.FAILED
    assert doubted.checked == [(Stage.SYNTHESIZE,)], "what its stage runs on was tried"
    assert doubted.fitness.reason == ""


@pytest.mark.parametrize("error", [MeshError("torn"), DamagedError("no JSON")])
def test_bad_input_casts_no_doubt_on_the_worker(doubted: Doubted, error: Exception) -> None:
    doubted.engine_works = False
    assert doubted.run(message_for(), raising(error)).kind is EventKind.FAILED and doubted.checked == []


def test_failures_in_a_row_that_others_do_not_have_are_the_workers(doubted: Doubted) -> None:
    for seed in (1, 2):
        assert doubted.fail(seed).kind is EventKind.FAILED
        make_shard(doubted.store, message_for(seed=seed), worker="another")
    event = doubted.fail(3)
    assert (event.kind, task_attempts(doubted.store, event.task_id)) == (EventKind.RETURNED, [])
    assert doubted.fitness.reason == "2 tasks in a row failed here and were done by other workers"


@pytest.mark.parametrize("done_elsewhere", [0, 1])
def test_tasks_that_others_fail_too_are_no_fault_of_the_worker(doubted: Doubted, done_elsewhere: int) -> None:
    for seed in range(6):
        assert doubted.fail(seed).kind is EventKind.FAILED
        if seed < done_elsewhere:
            make_shard(doubted.store, message_for(seed=seed), worker="another")


def test_a_success_in_between_ends_the_row(doubted: Doubted) -> None:
    for seed in (1, 2):
        doubted.fail(seed)
        make_shard(doubted.store, message_for(seed=seed), worker="another")
    assert doubted.run(message_for(seed=9)).kind is EventKind.FINISHED
    assert doubted.fail(3).kind is EventKind.FAILED


def test_a_worker_comes_back_once_its_engine_works_or_gives_up(doubted: Doubted) -> None:
    doubted.engine_works = False
    assert not doubted.fitness.try_engine((Stage.SYNTHESIZE,)) and not doubted.sits_out()
    assert len(doubted.checked) == 1 + len(module.PAUSES_S)
    doubted.states.clear()
    doubted.engine_works = True
    assert doubted.sits_out()
    reason = "synthesize: ImportError: libcuda.so.1"
    assert doubted.states == [{"state": "quarantined", "reason": reason}, {"state": "idle", "reason": ""}]


def test_a_fault_that_the_check_cannot_see_is_not_cured_by_passing_it(doubted: Doubted) -> None:
    test_failures_in_a_row_that_others_do_not_have_are_the_workers(doubted)
    assert not doubted.sits_out(), "a fresh process must start"


def test_a_worker_in_quarantine_stops_when_told(doubted: Doubted, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PAUSES_S", (600.0,))
    doubted.engine_works = False
    assert not doubted.fitness.try_engine((Stage.SYNTHESIZE,)) and not doubted.sits_out(told_to_stop=True)


@pytest.mark.parametrize("stage", Stage)
def test_the_engine_of_every_stage_passes(stage: Stage) -> None:
    check_engine(lambda: "cpu", (stage,))


def test_an_engine_that_breaks_or_gives_nonsense_does_not_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = generation.validated_grasps

    def broken_engine(*args, **options) -> None:
        raise ImportError("libwarp.so: cannot open\nshared object file")

    def nonsense(*args, **options):
        found = plan(*args, **options)
        found.grasps.grasp.hand_pose[:] = float("nan")
        return found

    for engine, said in (
        (broken_engine, "synthesize: ImportError: libwarp.so: cannot open shared object file"),
        (nonsense, "synthesize: ArithmeticError: a grasp of a ball is not finite"),
    ):
        monkeypatch.setattr(generation, "validated_grasps", engine)
        with pytest.raises(EngineError) as caught:
            check_engine(lambda: "cpu", (Stage.SYNTHESIZE,))
        assert str(caught.value) == said
