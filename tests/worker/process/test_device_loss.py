"""A GPU that breaks down under a task: the task goes back, and the process ends for a fresh one to start."""

import logging
from functools import partial

import pytest

from graspd.service.model.states import Priority, Stage
from graspd.service.queue.port import EventKind
from graspd.service.store.manifests import shard_exists
from graspd.service.store.records import task_attempts
from graspd.worker.engines.devices import DeviceLost
from graspd.worker.pool.pool import ProcessLost
from graspd.worker.process import engine
from graspd.worker.process.runner import Runner
from tests.fakes import fake_synthesize, message_for
from tests.worker.process.test_runner import Bench, raising


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


def test_the_worker_ends_and_leaves_the_other_tasks(rq_queue, work, kinds, monkeypatch, caplog) -> None:
    monkeypatch.setattr(engine, "Runner", partial(Runner, check_device=broken))
    rq_queue.enqueue([message_for(), message_for(seed=1)], Priority.BULK)
    with caplog.at_level(logging.ERROR):
        assert not work({Stage.SYNTHESIZE: fake_synthesize}, burst=False), "its supervisor should know"
    assert kinds()[:2] == [EventKind.STARTED, EventKind.RETURNED] and kinds().count(EventKind.STARTED) == 1
    assert rq_queue.leases() == []
    assert any(line.startswith("this worker ends: CUDA error 700") for line in caplog.messages)
