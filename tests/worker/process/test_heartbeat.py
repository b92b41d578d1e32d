"""Signs of life while the interpreter is busy elsewhere, and giving up on a task that never stops."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from service.model.clock import timestamp
from service.model.states import Stage
from service.model.worker_beat import WorkerBeat
from service.queue.port import EventKind
from service.queue.rq_queue import RqQueue, worker_key
from service.store.store import open_store
from tests.fakes import hold_interpreter
from tests.waiting import PATIENCE_S, until
from worker.process.heartbeat import Heartbeat, Hold, place_of
from worker.process.pulse import STUCK_AFTER_S, Pulse, is_stopped
from worker.stages.context import StopReason, TaskContext

LEASE_S = 2.0
ENTRY = "task-1:execution"


def beat_of(state: str = "idle") -> WorkerBeat:
    now = timestamp()
    return WorkerBeat("w", "h", 1, "cpu", "CPU", tuple(Stage), "0", state, "", now, now)


def hold_of(context: TaskContext) -> Hold:
    return Hold("task", context, ENTRY, "registry", timeout_s=60.0)


@pytest.fixture
def context() -> TaskContext:
    return TaskContext(open_store("memory://"))


@pytest.fixture
def heart(rq_queue: RqQueue, redis_server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Heartbeat]:
    """A heart whose first beat was seen."""
    monkeypatch.setattr("worker.process.heartbeat._LEAVE_S", PATIENCE_S)
    heart = Heartbeat(redis_server, beat_of(), lease_s=LEASE_S)
    heart.start()
    until(lambda: rq_queue.connection.exists(worker_key("w")), "the first beat")
    yield heart
    heart.stop()


def test_it_beats_while_nothing_else_in_the_process_can_run(heart: Heartbeat, rq_queue: RqQueue) -> None:
    # On a busy machine the pulse too may not come to run for so long.
    for _ in range(10):
        begun = timestamp()
        hold_interpreter(1.5 * LEASE_S)
        ended = timestamp()
        beat = json.loads(rq_queue.connection.get(worker_key("w")) or b'{"seen": ""}')
        # Half a lease before the end the registration of a worker without a beat would have ended.
        if begun < beat["seen"] < ended:
            return
    raise AssertionError(f"no beat between {begun} and {ended}: {beat}")


def test_a_cancelled_task_hears_of_it(heart: Heartbeat, rq_queue: RqQueue, context: TaskContext) -> None:
    rq_queue.connection.zadd("registry", {ENTRY: 1.0})
    heart.hold(hold_of(context))
    until(lambda: (rq_queue.connection.zscore("registry", ENTRY) or 0.0) > 1.0, "the lease is renewed")
    assert context.stop_reason is None
    rq_queue.discard(["task"])
    until(lambda: context.stop_reason, "the task hears of it")
    assert context.stop_reason is StopReason.CANCELLED


def test_a_task_in_hand_keeps_its_lease_and_hears_that_it_is_cancelled(
    heart: Heartbeat, rq_queue: RqQueue, context: TaskContext
) -> None:
    rq_queue.connection.zadd("registry", {ENTRY: 1.0})
    heart.hold(hold_of(context))
    until(lambda: rq_queue.connection.zscore("registry", ENTRY) > 1.0, "a beat for it")
    assert context.stop_reason is None
    rq_queue.discard(["task"])
    until(lambda: context.stop_reason, "the task hears of it")
    assert context.stop_reason is StopReason.CANCELLED


def test_a_task_whose_lease_was_taken_hears_of_it(heart: Heartbeat, context: TaskContext) -> None:
    heart.hold(hold_of(context))
    until(lambda: context.stop_reason, "the task hears of it")
    assert context.stop_reason is StopReason.LEASE_LOST


def test_a_lease_that_was_taken_is_not_made_again(heart: Heartbeat, rq_queue: RqQueue, context: TaskContext) -> None:
    heart.hold(hold_of(context))
    until(lambda: context.stop_reason, "a beat for it")
    assert not rq_queue.connection.exists("registry", f"rq:execution:{ENTRY}", "rq:executions:task-1")


def test_signs_of_life_that_were_killed_are_started_again(heart: Heartbeat, rq_queue: RqQueue) -> None:
    first = heart.pid
    assert first is not None
    heart.update(state="busy")
    os.kill(first, signal.SIGKILL)
    # A beat of the first may still be on its way.
    until(lambda: heart.pid != first, "another pulse")
    rq_queue.connection.delete(worker_key("w"))
    until(lambda: rq_queue.workers(), "another beat")
    assert [beat.state for beat in rq_queue.workers()] == ["busy"], "it knows what the worker is at"


def test_a_worker_that_leaves_is_not_lost(heart: Heartbeat, rq_queue: RqQueue) -> None:
    heart.stop()
    assert rq_queue.workers() == []
    assert [event.kind for _, event in rq_queue.tail("0", limit=10, wait_s=0)] == [EventKind.LEFT]


_WORKER = """
import sys, time
from tests.worker.process.test_heartbeat import LEASE_S, beat_of
from worker.process.heartbeat import Heartbeat
heart = Heartbeat(sys.argv[1], beat_of(sys.argv[2]), lease_s=LEASE_S)
heart.start()
print(heart.pid, flush=True)
time.sleep(600)
"""


@pytest.fixture
def worker(rq_queue: RqQueue, redis_server: str) -> Iterator[Callable[..., tuple[subprocess.Popen[bytes], int]]]:
    """Starts a process with a heart; gives it and the pid of its pulse, once it was seen to beat."""
    started: list[subprocess.Popen[bytes]] = []

    def start(state: str = "idle") -> tuple[subprocess.Popen[bytes], int]:
        started.append(subprocess.Popen([sys.executable, "-c", _WORKER, redis_server, state], stdout=subprocess.PIPE))
        assert started[-1].stdout is not None
        pulse = int(started[-1].stdout.readline())
        until(lambda: rq_queue.connection.exists(worker_key("w")), "the first beat")
        return started[-1], pulse

    yield start
    for process in started:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def test_a_worker_that_was_stopped_by_a_signal_falls_silent(worker: Callable[..., Any], rq_queue: RqQueue) -> None:
    process, _ = worker()
    process.send_signal(signal.SIGSTOP)
    until(lambda: rq_queue.workers() == [], "its registration ends")
    process.send_signal(signal.SIGCONT)
    until(rq_queue.workers, "it gives signs of life again")


@pytest.mark.parametrize(("state", "left"), [("idle", []), ("checking", [EventKind.LEFT])])
def test_no_pulse_outlives_its_worker_and_only_one_that_took_tasks_is_lost(
    worker: Callable[..., Any], rq_queue: RqQueue, state: str, left: list[EventKind]
) -> None:
    process, pulse = worker(state)
    process.kill()
    process.wait()
    until(lambda: is_stopped(pulse), "the pulse ended")
    assert [event.kind for _, event in rq_queue.tail("0", limit=10, wait_s=0)] == left


class Silence:
    """A Redis that takes everything."""

    def pipeline(self) -> Silence:
        return self

    def __enter__(self) -> Silence:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def execute(self) -> list[Any]:
        return [True, 1, 1, *(1, 1, 1, 1.0, 0) * 4]

    def __getattr__(self, name: str) -> Any:
        return lambda *args, **kwargs: None


def test_a_task_is_stopped_when_its_time_is_over_and_then_its_worker() -> None:
    now, said, ended = [0.0], [], []
    pulse = Pulse(
        Silence(),
        place_of("w", LEASE_S),
        tell=lambda word, about: said.append((word, about)),
        end_worker=ended.append,
        clock=lambda: now[0],
    )
    at = {"beat": asdict(beat_of("busy")), "limit": {"id": ENTRY, "seconds": 10.0}}
    pulse.take(at)
    pulse.tick()
    assert said == []
    now[0] = 10.5
    pulse.take(at)
    pulse.tick()
    assert said == [("timeout", ENTRY)], "being told the same again does not start its time anew"
    assert ended == []
    now[0] = 11.0 + STUCK_AFTER_S
    pulse.tick()
    assert ended and "does not stop" in ended[0]


def test_each_task_has_a_time_of_its_own() -> None:
    now, said = [0.0], []
    pulse = Pulse(
        Silence(),
        place_of("w", LEASE_S),
        tell=lambda word, about: said.append((word, about)),
        end_worker=lambda why: None,
        clock=lambda: now[0],
    )

    def hold(entry: str) -> dict[str, Any]:
        return {"entry": entry, "registry": "r", "cancel": "c", "kept": [], "seconds": 10.0}

    pulse.take({"beat": asdict(beat_of("busy")), "hold": hold("a-1:x")})
    now[0] = 6.0
    pulse.take({"beat": asdict(beat_of("busy")), "hold": hold("b-1:y")})
    now[0] = 11.0
    pulse.tick()
    assert said == []
    now[0] = 16.5
    pulse.tick()
    assert said == [("timeout", "b-1:y")]


def test_the_first_reason_to_stop_stands(context: TaskContext) -> None:
    context.stop(StopReason.SHUTDOWN)
    context.stop(StopReason.LEASE_LOST)
    assert context.stop_reason is StopReason.SHUTDOWN


def test_a_worker_that_beats_touches_its_file(rq_queue: RqQueue, redis_server: str, tmp_path: Path) -> None:
    file = tmp_path / "alive"
    heart = Heartbeat(redis_server, beat_of(), lease_s=LEASE_S, alive=file)
    heart.start()
    try:
        until(file.exists, "the file is touched")
    finally:
        heart.stop()
