"""A worker's signs of life, from a small process of its own: `python -m worker.process.pulse PARENT_PID`.

A kernel that compiles holds the worker's interpreter lock for many seconds, and on a busy machine for many more. This
process shares no lock with it, imports no engine, and ends with the worker. It falls silent when the worker is stopped,
and ends a worker that does not stop when it must.

Lines of JSON come in on stdin: where Redis is, then each time what the worker is at; the last line counts. Words go
out on stdout: why a task in hand must stop, and after every beat a dot.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from redis.exceptions import RedisError

from service.heartbeat_file import HeartbeatFile
from service.model.clock import timestamp
from service.queue.connection import connect
from service.queue.rates import beat_every_s

#: How long Redis keeps a lease without a beat [s]: much longer than the keeper, which watches beats, takes to act.
LEASE_KEPT_S: Final = 3600
#: Time a task has to notice that it must stop before its worker is ended [s].
STUCK_AFTER_S: Final = 60.0
#: News is not told more often than this [s].
_SHORTEST_INTERVAL_S: Final = 0.1
_ANSWER_S: Final = 3.0
#: A worker that ends in one of these leaves nobody waiting: it is not lost.
_WITHOUT_TASKS: Final = ("checking", "quarantined")


class Pulse:
    """Beats for one worker.

    `place` names the keys (`worker`, `workers`, `events`), `events_kept`, `lease_s`, and the file `alive`, if there is
    one. What the worker is at: `beat` is what its registration says; `limit` names a piece of work that must end (`id`,
    `seconds`); `hold` is the lease of a task (`entry`, the keys `registry` and `cancel`, two that are `kept`, and
    `seconds`, in which the task must end), if there is one.
    """

    def __init__(
        self,
        connection: Any,
        place: dict[str, Any],
        *,
        tell: Callable[[str, str], None],
        end_worker: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._connection = connection
        self._place = place
        self._tell = tell
        self._end_worker = end_worker
        self._clock = clock
        self._now_at: dict[str, Any] = {}
        self._since: dict[str, float] = {}
        """When each piece of work that must end began."""
        self.interval_s = beat_every_s(1, place["lease_s"])

    def take(self, now_at: dict[str, Any]) -> None:
        """What the worker is at from now on."""
        self._since = {name: self._since.get(name, self._clock()) for name in _limits(now_at)}
        self._now_at = now_at

    def tick(self) -> None:
        """One beat; says whether the task in hand must stop. Raises RedisError when Redis is away."""
        if not self._now_at:
            return
        self._watch_time()
        hold = self._now_at.get("hold")
        beat = self._now_at["beat"] | {"seen": timestamp()}
        with self._connection.pipeline() as pipe:
            pipe.set(self._place["worker"], json.dumps(beat), ex=max(2, round(self._place["lease_s"])))
            pipe.sadd(self._place["workers"], beat["name"])
            pipe.scard(self._place["workers"])
            if hold:
                # Nothing is made that is not there: the task may be done, or taken away, by now.
                pipe.zadd(hold["registry"], {hold["entry"]: time.time() + LEASE_KEPT_S}, xx=True)
                for key in hold["kept"]:
                    pipe.expire(key, LEASE_KEPT_S)
                pipe.zscore(hold["registry"], hold["entry"])
                pipe.exists(hold["cancel"])
            results = pipe.execute()
        self.interval_s = beat_every_s(results[2], self._place["lease_s"])
        if hold:
            score, cancelled = results[6:8]
            if cancelled:
                self._tell("cancelled", hold["entry"])
            elif score is None:
                self._tell("lease lost", hold["entry"])

    def leave(self) -> None:
        """End the registration, and say that this worker is not lost."""
        name = self._now_at["beat"]["name"]
        left = json.dumps({"kind": "left", "at": timestamp(), "worker": name})
        with self._connection.pipeline() as pipe:
            pipe.delete(self._place["worker"])
            pipe.srem(self._place["workers"], name)
            pipe.xadd(self._place["events"], {"e": left}, maxlen=self._place["events_kept"], approximate=True)
            pipe.execute()

    @property
    def leaves(self) -> bool:
        """Whether the worker said that it leaves."""
        return bool(self._now_at.get("leave"))

    @property
    def is_without_tasks(self) -> bool:
        """Whether the worker took no tasks when it was last heard of."""
        return bool(self._now_at) and self._now_at["beat"]["state"] in _WITHOUT_TASKS

    def _watch_time(self) -> None:
        for name, seconds in _limits(self._now_at).items():
            running = self._clock() - self._since[name]
            if running > seconds:
                self._tell("timeout", name)
            if running > seconds + STUCK_AFTER_S:
                self._end_worker(f"{name} does not stop; its worker is ended, and its tasks are taken from it")


def _limits(now_at: dict[str, Any]) -> dict[str, float]:
    """What must end, and how long it may take [s]."""
    limit = now_at.get("limit")
    found = {limit["id"]: limit["seconds"]} if limit else {}
    return found | ({hold["entry"]: hold["seconds"]} if (hold := now_at.get("hold")) else {})


def is_stopped(pid: int) -> bool:
    """Whether a process was stopped by a signal, as by SIGSTOP: then it does not live, though it is there."""
    if sys.platform == "linux":
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (OSError, IndexError):
            return True
    else:
        listing = subprocess.run(["ps", "-o", "state=", "-p", str(pid)], capture_output=True, check=False, text=True)
        state = listing.stdout.strip()[:1]
    return state in ("T", "t", "Z", "X", "")


class _Lines:
    """Lines from stdin, waited for no longer than wanted."""

    def __init__(self) -> None:
        self._buffer = b""
        self.ended = False

    def read(self, wait_s: float) -> list[dict[str, Any]]:
        """The lines that came in."""
        if not select.select([0], [], [], max(0.0, wait_s))[0]:
            return []
        data = os.read(0, 1 << 16)
        self.ended = not data
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        return [json.loads(line) for line in lines]


def _say(word: str, about: str = "") -> None:
    # Where the worker does not listen, or is gone, stdin tells which.
    with contextlib.suppress(OSError):
        os.write(1, f"{word}\t{about}\n".encode())


def _complain(message: str) -> None:
    line = {"time": timestamp(), "level": "WARNING", "process": "worker", "pid": os.getpid(), "message": message}
    sys.stderr.write(json.dumps(line) + "\n")
    sys.stderr.flush()


def _end(parent: int, why: str) -> None:
    if os.getppid() != parent:
        return  # it is gone, and its number may be another's
    _complain(why)
    os.kill(parent, signal.SIGKILL)


def run(parent: int) -> None:
    """Beat until the worker leaves or ends."""
    lines = _Lines()
    while not (found := lines.read(60.0)):
        if lines.ended or os.getppid() != parent:
            return
    place, *found = found
    connection = connect(place["url"], patience=0, timeout_s=_ANSWER_S)
    pulse = Pulse(connection, place, tell=_say, end_worker=lambda why: _end(parent, why))
    alive = HeartbeatFile(Path(place["alive"]) if place.get("alive") else None)
    last, due, away = -_SHORTEST_INTERVAL_S, 0.0, False
    while True:
        if found:
            pulse.take(found[-1])
            due = min(due, last + _SHORTEST_INTERVAL_S)
        if lines.ended or pulse.leaves or os.getppid() != parent:
            break
        if time.monotonic() >= due:
            last = time.monotonic()
            due = last + pulse.interval_s
            away = _beat(pulse, parent, alive, away)
        found = lines.read(due - time.monotonic())
    if pulse.leaves or pulse.is_without_tasks:
        pulse.leave()


def _beat(pulse: Pulse, parent: int, alive: HeartbeatFile, was_away: bool) -> bool:
    """One beat, unless the worker is stopped; returns whether Redis was away, which is said once."""
    if is_stopped(parent):
        return was_away
    try:
        pulse.tick()
    except RedisError as error:
        if not was_away:
            _complain(f"no sign of life could be given: {error}")
        return True
    finally:
        alive.touch()
        _say(".")
    return False


def main() -> None:
    """The process. Signals to end are the worker's: this one ends with it."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.set_blocking(1, False)
    try:
        run(int(sys.argv[1]))
    except RedisError as error:
        _complain(f"Redis was away when the worker left: {error}")


if __name__ == "__main__":
    main()
