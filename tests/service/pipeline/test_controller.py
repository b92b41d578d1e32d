"""The controller on in-memory services: lost workers, lost events, lost queue, lost index, parts that are away."""

import json
import threading
from typing import Any
from unittest.mock import Mock

import pytest

from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.domain import Asset
from graspd.service.model.errors import ConflictError, QueueUnavailable, StoreUnavailable
from graspd.service.model.messages import IngestMessage, TaskMessage
from graspd.service.model.states import AssetKind, Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller
from graspd.service.pipeline.job_actions import Routes
from graspd.service.pipeline.lease_reaper import LOST_AFTER_S
from graspd.service.queue.port import Event, EventKind, rq_id
from graspd.service.store.library import publish_asset, stored_assets
from graspd.service.store.records import task_attempts
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.process.runner import Runner
from graspd.worker.stages.context import StopReason, TaskContext
from tests.fakes import HAND_FILES, fake_stages, request, with_settings
from tests.indexes import empty_index
from tests.memory_queue import Delivery, MemoryQueue, events_after
from tests.waiting import Clock, until


class Bench:
    """A controller and one worker, both moved step by step."""

    def __init__(self, services: Services) -> None:
        self.services, self.queue, self.clock = services, services.queue, Clock()
        self.controller = Controller(services, clock=self.clock)

    def pass_time(self, seconds: float, *, beating: Delivery | None = None) -> None:
        """Rounds of the controller, one a second."""
        for _ in range(round(seconds)):
            self.clock.now += 1.0
            if beating is not None:
                self.queue.beat(beating)
            self.controller.run_round()

    def take(self) -> Delivery:
        delivery = self.queue.take("w")
        assert delivery is not None
        return delivery

    def do(self, delivery: Delivery, *, device: str = "cpu", **stages: Any) -> Event | None:
        table = fake_stages() | {Stage(name): stage for name, stage in stages.items()}
        # The name of a device is all that these stages see of it.
        runner = Runner(table, worker="w", publish=self.queue.publish, check_device=lambda device: None)
        raw = delivery.message.model_dump(mode="json", by_alias=True)
        outcome = runner.run(raw, TaskContext(self.services.store, ExecutionContext(device)))
        self.queue.finish(delivery)
        if outcome is not None:
            self.queue.publish(outcome)
        return outcome

    def work_off(self, **how: Any) -> list[EventKind]:
        """Worker and controller in turns until nothing waits; how each task ended."""
        ends = []
        self.pass_time(1)
        while (delivery := self.queue.take("w")) is not None:
            ends += [event.kind for event in [self.do(delivery, **how)] if event is not None]
            self.pass_time(1)
        return ends

    def lose_workers(self) -> None:
        """Every worker that takes the task falls silent."""
        for _ in range(self.services.settings.task_attempts):
            self.take()
            self.pass_time(self.services.settings.lease_s + 2)
        assert self.queue.take("w") is None


@pytest.fixture
def bench(services: Services) -> Bench:
    made = Bench(services)
    made.controller.run_round()
    return made


def explode(message: TaskMessage, context: TaskContext) -> None:
    raise ValueError("the planner lost its way")


def store_away(*_: object, **__: object) -> None:
    raise StoreUnavailable("the store does not answer")


def add_upload(bench: Bench) -> Asset:
    """A hand that nobody has checked yet."""
    asset = publish_asset(bench.services.store, AssetKind.HAND, "upload", HAND_FILES | {"extra": b"3"})
    bench.services.index.write.add_asset(asset, None)
    return asset


def test_a_job_goes_through_all_its_stages_and_tells_listeners(bench: Bench) -> None:
    job, _ = job_actions.submit(bench.services, request(grasps=70, scenes=2))
    bench.work_off()
    done = bench.services.index.jobs.get(job.id)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 70)
    assert differences(bench.services.index, bench.services.store) == []
    told = [e for _, e in events_after(bench.queue)]
    assert [e.message for e in told if e.kind is EventKind.JOB] == ["queued", "running", "succeeded"]
    assert {e.job_id for e in told if e.kind is EventKind.JOB} == {job.id}


def test_a_worker_that_beats_keeps_its_task(bench: Bench) -> None:
    job_actions.submit(bench.services, request())
    delivery = bench.take()
    bench.pass_time(100, beating=delivery)
    bench.clock.now += 3600
    bench.controller.run_round()
    assert [lease.key for lease in bench.queue.leases()] == [delivery.key]


def test_while_redis_takes_no_writes_nobody_is_called_silent(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    job_actions.submit(bench.services, request())
    held = bench.take()
    bench.pass_time(2, beating=held)
    with monkeypatch.context() as patch:
        away = QueueUnavailable("Redis does not answer (MISCONF: the disk is full)")
        patch.setattr(bench.queue, "announce", Mock(side_effect=away))
        for _ in range(10 * round(bench.services.settings.lease_s)):
            bench.clock.now += 1.0
            with pytest.raises(QueueUnavailable):
                bench.controller.run_round()
    bench.pass_time(2, beating=held)
    assert [lease.key for lease in bench.queue.leases()] == [held.key]
    assert bench.services.index.jobs.attempts() == []


def test_a_worker_that_was_only_slow_changes_nothing(bench: Bench) -> None:
    job, _ = job_actions.submit(bench.services, request())
    slow = bench.take()
    bench.pass_time(bench.services.settings.lease_s + 2)
    bench.do(bench.take())
    bench.pass_time(1)
    (before,) = bench.services.index.shards.page(job=job.id).items
    bench.do(slow)
    bench.pass_time(1)
    (after,) = bench.services.index.shards.page(job=job.id).items
    assert after == before
    assert bench.services.index.overview.stats().grasps == 32


def test_a_task_that_kills_every_worker_stops_after_its_attempts(bench: Bench) -> None:
    job, _ = job_actions.submit(bench.services, request(scenes=1))
    task = bench.services.index.jobs.tasks(job=job.id).items[0].id
    bench.services.queue.put_task_log(rq_id(task, 1), "its last line")
    bench.lose_workers()
    failed = bench.services.index.jobs.get(job.id)
    assert failed.state is State.FAILED
    assert failed.reason is not None and "was lost: no heartbeat for 6 s" in failed.reason
    attempts = bench.services.index.jobs.attempts(job=job.id)
    assert [(a.number, a.kind, a.last) for a in attempts] == [(n, "WorkerLost", n == 3) for n in (3, 2, 1)]
    assert [a.log for a in task_attempts(bench.services.store, task)] == ["its last line", "", ""]
    assert differences(bench.services.index, bench.services.store) == []


def test_a_failing_task_fails_its_job_alone(bench: Bench) -> None:
    bad, _ = job_actions.submit(bench.services, request(seed=1))
    for _ in range(3):
        bench.do(bench.take(), synthesize=explode)
        bench.pass_time(1)
    good, _ = job_actions.submit(bench.services, request(seed=2))
    bench.work_off()
    failed = bench.services.index.jobs.get(bad.id)
    assert (failed.state, failed.reason) == (State.FAILED, "the planner lost its way")
    assert bench.services.index.jobs.get(good.id).state is State.SUCCEEDED
    attempts = bench.services.index.jobs.attempts(job=bad.id)
    assert [(a.number, a.kind, a.last) for a in attempts] == [(n, "ValueError", n == 3) for n in (3, 2, 1)]
    assert "explode" in (attempts[0].trace or "")
    assert differences(bench.services.index, bench.services.store) == []


def test_a_failed_attempt_waits_before_the_next(bench: Bench) -> None:
    bench = Bench(with_settings(bench.services, retry_backoff_s=60.0))
    job_actions.submit(bench.services, request())
    bench.do(bench.take(), synthesize=explode)
    bench.pass_time(5)
    assert bench.queue.take("w") is None


def test_a_store_that_is_away_costs_no_attempt_and_says_so(bench: Bench) -> None:
    job, _ = job_actions.submit(bench.services, request())
    outcome = bench.do(bench.take(), synthesize=store_away)
    assert outcome is not None and outcome.kind is EventKind.DEFERRED
    bench.controller._index_events(0)
    waiting = bench.services.index.jobs.tasks(job=job.id).items[0]
    assert (waiting.state, waiting.message) == (State.QUEUED, "waits: the store does not answer")
    bench.work_off()
    assert bench.services.index.jobs.get(job.id).state is State.SUCCEEDED
    assert bench.services.index.jobs.attempts(job=job.id) == []


def test_while_the_store_is_away_what_does_not_need_it_is_known(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Events that need it wait, and come again to the next controller."""
    job, _ = job_actions.submit(bench.services, request(grasps=64))
    bench.do(bench.take())
    with monkeypatch.context() as patch:
        patch.setattr(bench.services.store, "get", store_away)
        bench.do(bench.take(), synthesize=store_away)
        for _ in range(3):
            with pytest.raises(StoreUnavailable, match="1 events wait for it"):
                bench.pass_time(1)
        states = [(task.state, task.message) for task in bench.services.index.jobs.tasks(job=job.id).items]
        assert states == [(State.RUNNING, None), (State.QUEUED, "waits: the store does not answer")]
    bench.queue.restart_consumer()
    bench = Bench(bench.services)
    bench.work_off()
    assert bench.services.index.jobs.get(job.id).state is State.SUCCEEDED
    assert bench.services.index.jobs.attempts(job=job.id) == []


def test_a_task_handed_back_at_shutdown_is_queued_at_once(bench: Bench) -> None:
    def told_to_stop(message: TaskMessage, context: TaskContext) -> None:
        context.stop(StopReason.SHUTDOWN)
        context.check()

    job_actions.submit(bench.services, request())
    bench.do(bench.take(), synthesize=told_to_stop)
    bench.pass_time(1)
    assert bench.take().message.attempt == 1


def test_redis_lost_whole_loses_no_task(bench: Bench) -> None:
    job, _ = job_actions.submit(bench.services, request(grasps=96, scenes=1))
    bench.do(bench.take())
    bench.take()
    empty = MemoryQueue()
    bench = Bench(Services(bench.services.settings, bench.services.store, bench.services.index, empty))
    bench.pass_time(LOST_AFTER_S + 2)
    assert len(empty.waiting_tasks()) == 3, "two syntheses, and the scene of the shard whose event was lost"
    bench.work_off()
    assert bench.services.index.jobs.get(job.id).state is State.SUCCEEDED
    assert differences(bench.services.index, bench.services.store) == []


def test_a_lost_failure_event_is_made_good_from_the_store(bench: Bench) -> None:
    job, _ = job_actions.submit(bench.services, request())
    delivery = bench.take()
    runner = Runner({Stage.SYNTHESIZE: explode}, worker="w", publish=lambda event: None)  # type: ignore[dict-item]
    runner.run(delivery.message.model_dump(mode="json", by_alias=True), TaskContext(bench.services.store))
    bench.queue.finish(delivery)
    bench.pass_time(LOST_AFTER_S + 2)
    assert bench.take().message.attempt == 2
    assert [a.number for a in bench.services.index.jobs.attempts(job=job.id)] == [1]


def test_a_damaged_manifest_fails_its_task_and_stops_no_other(bench: Bench) -> None:
    bad, _ = job_actions.submit(bench.services, request(seed=1))
    delivery = bench.take()
    key = names.shard_manifest_key(delivery.message.stage, delivery.message.output)
    bench.services.store.put(key, b'{"version": 1, "shard_id": torn')
    bench.do(delivery)
    good, _ = job_actions.submit(bench.services, request(seed=2))
    bench.work_off()
    bench.pass_time(LOST_AFTER_S + 2)
    assert bench.services.index.jobs.get(good.id).state is State.SUCCEEDED
    failed = bench.services.index.jobs.get(bad.id)
    assert failed.state is State.FAILED
    assert key in (failed.reason or "") and "remove it and retry its job" in (failed.reason or "")


def test_tasks_queued_while_the_controller_looks_are_queued_once(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """The controller has read the queue before, and the index before the job's tasks are marked there."""
    with monkeypatch.context() as late:
        late.setattr(job_actions, "queue_tasks", lambda *_, **__: set())
        job, _ = job_actions.submit(bench.services, request())
    feed = type(bench.services.index.feed)
    ready = feed.ready_tasks
    taken: list[Delivery] = []

    def beside(index: Any, *given: Any, **named: Any) -> Any:
        seen = ready(index, *given, **named)
        mine = bench.services.index.feed.ready_tasks_of_job(job.id, limit=9)
        job_actions.queue_tasks(bench.services, mine, routes=Routes(bench.queue.workers()))
        if bench.queue.waiting_tasks():
            taken.append(bench.take())
        return seen

    monkeypatch.setattr(feed, "ready_tasks", beside)
    bench.controller._reconcile_queue()
    assert len(taken) == 1 and bench.queue.waiting_tasks() == set(), "the worker's task waits a second time"


def test_a_check_queued_meanwhile_is_queued_once(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """The controller has read the queue before, and the index before the check is marked there."""
    asset = add_upload(bench)
    bench.pass_time(1)
    assert isinstance(bench.take().message, IngestMessage)
    bench.services.index.live.set_asset_waiting([asset.digest], queued=False)
    monkeypatch.setattr(MemoryQueue, "leases", lambda _: [])
    bench.controller._reconcile_queue()
    assert bench.queue.waiting_tasks() == set(), "the worker's check waits a second time"


def test_an_upload_is_checked_and_what_was_found_is_indexed(bench: Bench) -> None:
    add_upload(bench)

    def check(message: IngestMessage, context: TaskContext) -> None:
        found = {"verdict": "repair", "message": "one hole closed", "repairs": ["hole"], "facts": {"faces": 12}}
        context.store.put(names.asset_key(message.kind, message.digest, "check.json"), json.dumps(found).encode())

    bench.work_off(ingest=check)
    view = bench.services.index.assets.get(AssetKind.HAND, "upload")
    assert (view.verdict, view.repairs, view.facts) == ("repair", ["hole"], {"faces": 12})
    assert differences(bench.services.index, bench.services.store) == []


def test_a_check_that_failed_is_told_and_tried_again(bench: Bench) -> None:
    add_upload(bench)
    bench.pass_time(1)
    bench.do(bench.take(), ingest=explode)
    bench.pass_time(1)
    known = bench.services.index.assets.get(AssetKind.HAND, "upload")
    assert (known.verdict, known.message) == (None, "waits: the planner lost its way")
    with pytest.raises(ConflictError, match="the planner lost its way"):
        job_actions.submit(bench.services, request(hand="upload"))
    assert differences(bench.services.index, bench.services.store) == []
    until(lambda: bench.controller.run_round() or bench.queue.waiting_tasks(), "tried again")


def test_a_task_between_queue_and_worker_is_not_taken_for_lost(bench: Bench) -> None:
    job_actions.submit(bench.services, request())
    delivery = bench.take()
    bench.queue._held.clear()
    bench.pass_time(LOST_AFTER_S - 1)
    assert bench.queue.waiting_tasks() == set()
    bench.queue._held[delivery.key] = delivery
    bench.pass_time(LOST_AFTER_S + 1, beating=delivery)
    assert bench.queue.waiting_tasks() == set()


def test_files_below_an_asset_do_not_stop_a_controller(bench: Bench) -> None:
    (digest, *_) = [digest for kind, digest in stored_assets(bench.services.store) if kind is AssetKind.OBJECT]
    bench.services.store.put(names.asset_key(AssetKind.OBJECT, digest, "pieces/32.npz"), b"pieces")
    bench.controller.run_round()
    assert differences(bench.services.index, bench.services.store) == []


def test_an_index_lost_whole_is_made_again_from_the_store(bench: Bench) -> None:
    job, _ = job_actions.submit(bench.services, request(grasps=64, scenes=1))
    bench.do(bench.take())
    bench.pass_time(1)
    fresh = empty_index(f"sqlite:///{bench.services.settings.data_dir / 'fresh.sqlite'}")
    bench = Bench(Services(bench.services.settings, bench.services.store, fresh, bench.queue))
    bench.controller.run_round()
    waiting = len(bench.queue.waiting_tasks())
    bench.pass_time(LOST_AFTER_S + 2)
    assert len(bench.queue.waiting_tasks()) == waiting == 2, "what was in the queue is not queued twice"
    bench.work_off()
    assert fresh.jobs.get(job.id).state is State.SUCCEEDED
    assert differences(fresh, bench.services.store) == []
    fresh.close()


def test_forged_events_are_left_out_and_stop_nothing(bench: Bench) -> None:
    job, _ = job_actions.submit(bench.services, request())
    for output in ("../../etc/passwd", "0" * 32, "hand/x", ""):
        for kind in (EventKind.FINISHED, EventKind.FAILED, EventKind.STARTED):
            for stage in (Stage.SYNTHESIZE, Stage.INGEST):
                forged = {"kind": kind, "at": timestamp(), "task_id": "../x", "stage": stage, "output": output}
                bench.queue.publish(Event.model_construct(**forged, attempt=1))
    bench.work_off()
    assert bench.services.index.jobs.get(job.id).state is State.SUCCEEDED


def test_a_cancelled_task_that_still_runs_is_stopped(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    job, _ = job_actions.submit(bench.services, request())
    delivery = bench.take()
    with monkeypatch.context() as patch:
        patch.setattr(bench.queue, "discard", Mock(side_effect=QueueUnavailable("Redis does not answer")))
        assert job_actions.cancel(bench.services, job.id).state is State.CANCELLED
    assert bench.queue.beat(delivery) == (False, False)
    bench.pass_time(1)
    assert bench.queue.beat(delivery)[0], "the controller tells it"


def test_the_window_is_refilled_as_it_empties(bench: Bench) -> None:
    bench = Bench(with_settings(bench.services, queue_window=4))
    job, _ = job_actions.submit(bench.services, request(grasps=32 * 12))
    deepest = 0
    while (delivery := bench.queue.take("w")) is not None:
        deepest = max(deepest, len(bench.queue.waiting_tasks()) + 1)
        bench.do(delivery)
        bench.pass_time(1)
    assert deepest == 4
    assert bench.services.index.jobs.get(job.id).state is State.SUCCEEDED


def test_an_upload_that_kills_every_worker_is_refused(bench: Bench) -> None:
    add_upload(bench)
    bench.pass_time(1)
    bench.lose_workers()
    assert bench.services.index.assets.get(AssetKind.HAND, "upload").verdict == "refuse"


def test_the_loop_outlives_parts_that_are_away(services: Services, monkeypatch: pytest.MonkeyPatch) -> None:
    stop, rounds = threading.Event(), 0

    def failing(*, wait_s: float = 0.0) -> None:
        nonlocal rounds
        rounds += 1
        if rounds == 3:
            stop.set()
        raise (QueueUnavailable("away"), KeyError("a bug"))[rounds % 2]

    controller = Controller(services)
    monkeypatch.setattr(controller, "run_round", failing)
    # What goes on beside the rounds ends by it.
    monkeypatch.setattr(stop, "wait", lambda seconds: stop.is_set())
    controller.run(stop)
    assert rounds == 3
