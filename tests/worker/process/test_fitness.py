"""Which failures are the worker's own, and its check of itself with the real engine."""

from collections.abc import Collection

import pytest

from graspd.service.model.errors import DamagedError, MeshError
from graspd.service.model.states import Stage
from graspd.service.queue.port import Event, EventKind
from graspd.service.store.records import task_attempts
from graspd.worker import generation
from graspd.worker.process import fitness as module
from graspd.worker.process.fitness import Fitness
from graspd.worker.process.selfcheck import EngineError, check_engine
from tests.fakes import make_shard, message_for
from tests.worker.process.test_runner import Bench, raising


class Doubted(Bench):
    """A runner whose engine can be broken."""

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

    def broken(*args, **options) -> None:
        raise ImportError("libwarp.so: cannot open\nshared object file")

    def nonsense(*args, **options):
        found = plan(*args, **options)
        found.grasps.grasp.hand_pose[:] = float("nan")
        return found

    for engine, said in (
        (broken, "synthesize: ImportError: libwarp.so: cannot open shared object file"),
        (nonsense, "synthesize: ArithmeticError: a grasp of a ball is not finite"),
    ):
        monkeypatch.setattr(generation, "validated_grasps", engine)
        with pytest.raises(EngineError) as caught:
            check_engine(lambda: "cpu", (Stage.SYNTHESIZE,))
        assert str(caught.value) == said
