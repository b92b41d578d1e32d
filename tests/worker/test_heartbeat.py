"""Signs of life while the interpreter is busy elsewhere, and giving up on a task that never stops."""

from __future__ import annotations

import hashlib
import time
from types import SimpleNamespace
from typing import Any

import pytest
from redis.exceptions import ConnectionError as RedisConnectionError

from service.clock import timestamp
from service.domain import Stage
from service.queue.port import WorkerBeat
from service.store import open_store
from worker.context import StopReason, TaskContext
from worker.heartbeat import STUCK_AFTER_S, Heartbeat, Hold

INTERVAL_S = 0.05


class FakeRedis:
    """Counts what the heartbeat sends."""

    def __init__(self) -> None:
        self.beats: list[float] = []
        self.answers: list[Any] = [True, 1, None, 1.0, 0]
        self.away = False

    def pipeline(self) -> FakeRedis:
        return self

    def __enter__(self) -> FakeRedis:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def __getattr__(self, name: str) -> Any:
        return lambda *args, **kwargs: None

    def execute(self) -> list[Any]:
        if self.away:
            raise RedisConnectionError("away")
        self.beats.append(time.monotonic())
        return self.answers


def make(redis: FakeRedis, **options: Any) -> Heartbeat:
    now = timestamp()
    beat = WorkerBeat("w", "h", 1, "cpu", "CPU", tuple(Stage), "0", "idle", "", now, now)
    return Heartbeat(redis, beat, lease_s=3 * INTERVAL_S, **options)


def hold(context: TaskContext, *, timeout_s: float = 60.0, started: float | None = None) -> Hold:
    execution = SimpleNamespace(heartbeat=lambda *args, **kwargs: None, composite_key="k")
    registry = SimpleNamespace(key="r")
    return Hold("t", context, execution, registry, timeout_s, time.monotonic() if started is None else started)


@pytest.fixture
def context() -> TaskContext:
    return TaskContext(open_store("memory://"))


def test_it_beats_through_a_call_that_never_comes_back_to_python() -> None:
    redis = FakeRedis()
    heart = make(redis)
    heart.start()
    start = time.monotonic()
    # One call into C of about a second that releases the interpreter lock, as a kernel launch of Warp does.
    hashlib.pbkdf2_hmac("sha256", b"password", b"salt", 1_500_000)
    busy = time.monotonic() - start
    heart.stop()
    within = [beat for beat in redis.beats if start < beat < start + busy]
    assert busy > 4 * INTERVAL_S
    # A loaded machine may skip some; half of them is many times what the lease needs.
    assert len(within) >= busy / INTERVAL_S / 2


def test_redis_away_for_a_while_is_survived() -> None:
    redis = FakeRedis()
    heart = make(redis)
    redis.away = True
    heart.start()
    time.sleep(4 * INTERVAL_S)
    redis.away = False
    deadline = time.monotonic() + 5
    while not redis.beats and time.monotonic() < deadline:
        time.sleep(0.01)
    heart.stop()
    assert redis.beats


def test_a_cancelled_task_hears_of_it(context: TaskContext) -> None:
    redis = FakeRedis()
    redis.answers[-1] = 1
    make(redis)._tick(hold(context))
    assert context.stop_reason is StopReason.CANCELLED


def test_a_task_whose_lease_was_taken_hears_of_it(context: TaskContext) -> None:
    redis = FakeRedis()
    redis.answers[-2] = None
    make(redis)._tick(hold(context))
    assert context.stop_reason is StopReason.LEASE_LOST


def test_a_task_is_stopped_when_its_time_is_over(context: TaskContext) -> None:
    make(FakeRedis())._tick(hold(context, timeout_s=10, started=time.monotonic() - 11))
    assert context.stop_reason is StopReason.TIMEOUT


def test_a_task_that_does_not_stop_takes_its_worker_down(context: TaskContext) -> None:
    given_up: list[Hold] = []
    heart = make(FakeRedis(), give_up=given_up.append)
    stuck = hold(context, timeout_s=10, started=time.monotonic() - 11 - STUCK_AFTER_S)
    heart._tick(stuck)
    assert given_up == [stuck]


def test_the_first_reason_to_stop_stands(context: TaskContext) -> None:
    context.stop(StopReason.SHUTDOWN)
    context.stop(StopReason.LEASE_LOST)
    assert context.stop_reason is StopReason.SHUTDOWN
