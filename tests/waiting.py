"""Waiting for a fact, for as long as a machine that is busy with other things may need."""

import threading
import time
from collections.abc import Callable
from typing import Any, Final

import httpx

#: Longest wait: what takes a second on a quiet machine has come by then on any [s].
PATIENCE_S: Final = 120.0


def until(met: Callable[[], Any], what: str, *, seconds: float = PATIENCE_S, logs: Callable[[], str] = str) -> None:
    """Until a condition is met; fails with what was waited for, and the logs, when it does not come."""
    began = asked = time.monotonic()
    while not met():
        now = time.monotonic()
        assert now < began + seconds, f"after {seconds:g} s still not: {what}\n{logs()}"
        # Who looks for long waits for long: the processor is for what is waited for.
        time.sleep(max(0.05, 2 * (now - asked)))
        asked = time.monotonic()


def answers(url: str, client: httpx.Client | None = None) -> bool:
    try:
        got = client.get(url) if client else httpx.get(url, trust_env=False, timeout=60)
    except httpx.HTTPError:
        return False
    return got.status_code == 200


def until_a_worker_is_idle(address: str) -> None:
    """Until a worker of the service at an address takes tasks: a ready service may have some that still check their
    engine, which compiles kernels where none are kept."""

    def idle() -> bool:
        workers = httpx.get(f"{address}/v1/workers", timeout=60, trust_env=False).json()
        return any(worker["state"] == "idle" for worker in workers)

    until(idle, "a worker takes tasks")


class Pauses(threading.Event):
    """A word to stop, for which nobody waits: each pause moves its clock on."""

    now = 0.0

    def wait(self, timeout: float | None = None) -> bool:
        self.now += timeout or 0.0
        return self.is_set()

    def clock(self) -> float:
        return self.now


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now
