"""Child processes of a supervisor: start, restart with back-off, stop."""

import contextlib
import json
import logging
import os
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

log = logging.getLogger(__name__)
#: Environment variable of a child, by which a later `graspd up` identifies the process.
_TOKEN: Final = "GRASPD_CHILD_TOKEN"
_WATCH_S: Final = 0.1
_FIRST_PAUSE_S: Final = 0.2
_LONGEST_PAUSE_S: Final = 10.0
#: Uptime after which a child counts as healthy, and its next restart follows the shortest pause [s].
_WELL_AFTER_S: Final = 20.0


@dataclass
class Child:
    """Child process. One thread makes all calls, because the kernel kills children of an ended thread."""

    name: str
    command: Sequence[str]
    environment: Mapping[str, str]
    folder: Path | None
    """Data folder, with pid files in `run/` and output in `logs/`; None: no files, output of the parent."""
    fix: Callable[[Path], None] | None = None
    """Function that is called with the path of the log before the restart after a failure."""
    process: subprocess.Popen[bytes] | None = None
    starts: int = 0
    _started: float = 0.0
    _pause: float = _FIRST_PAUSE_S
    _not_before: float = 0.0

    @property
    def pid_file(self) -> Path | None:
        return self.folder and self.folder / "run" / f"{self.name}.pid"

    @property
    def _log_file(self) -> Path | None:
        return self.folder and self.folder / "logs" / f"{self.name}.log"

    def start(self) -> None:
        """Start the process in its own session, so that Ctrl-C in the terminal reaches only the parent."""
        token = secrets.token_hex(16)
        with self._output() as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "graspd.service.run.launch", str(os.getpid()), *self.command],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT if output is not None else None,
                env={**os.environ, **self.environment, _TOKEN: token},
                start_new_session=True,
            )
        if self.pid_file is not None:
            self.pid_file.parent.mkdir(parents=True, exist_ok=True)
            self.pid_file.write_text(json.dumps([self.process.pid, start_time(self.process.pid), token]))
        self.starts += 1
        self._started = time.monotonic()

    def restart_if_ended(self) -> None:
        """Restart the process if it has ended, after a pause that doubles with each further failure."""
        now = time.monotonic()
        if self.process is not None:
            code = self.process.poll()
            if code is None:
                return
            if code == 0 or now - self._started > _WELL_AFTER_S:
                self._pause = _FIRST_PAUSE_S
            # A worker ends with code 0 when it is to be replaced.
            level = logging.WARNING if code else logging.INFO
            log.log(level, "%s ended (%s); it is started again in %.2g s", self.name, _exit_text(code), self._pause)
            if code > 0 and self.fix is not None and self._log_file is not None:
                self.fix(self._log_file)
            self.process = None
            self._not_before = now + self._pause
            self._pause = min(_LONGEST_PAUSE_S, 2 * self._pause)
        elif now >= self._not_before:
            self.start()

    def terminate(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)

    def join(self, deadline: float) -> None:
        if self.process is not None:
            try:
                self.process.wait(timeout=max(0.05, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                log.warning("%s does not stop; it is killed", self.name)
                self.process.kill()
                self.process.wait()
            self.process = None
        if self.pid_file is not None:
            self.pid_file.unlink(missing_ok=True)

    def _output(self) -> AbstractContextManager[IO[bytes] | None]:
        if (file := self._log_file) is None:
            return nullcontext()
        file.parent.mkdir(parents=True, exist_ok=True)
        return file.open("ab")


def keep_alive(children: Sequence[Child], stop: threading.Event) -> None:
    for child in children:
        child.start()
    while not stop.wait(_WATCH_S):
        for child in children:
            child.restart_if_ended()


def stop_children(children: Sequence[Child], grace_s: float) -> None:
    """Ask all children to stop; kill those that still run after the grace time [s]."""
    for child in children:
        child.terminate()
    deadline = time.monotonic() + grace_s
    for child in children:
        child.join(deadline)


def kill_leftovers(folder: Path) -> list[int]:
    """Kill children of an earlier `graspd up` by their pid files, except reused pids; return the pids."""
    ended = []
    for file in (folder / "run").glob("*.pid"):
        with contextlib.suppress(ValueError, TypeError, OSError, OverflowError):
            pid, started, token = json.loads(file.read_text())
            if pid not in (os.getpid(), os.getppid()) and start_time(pid) == started and _has_token(pid, token):
                os.kill(pid, signal.SIGKILL)
                ended.append(pid)
        file.unlink(missing_ok=True)
    return ended


def _has_token(pid: int, token: str) -> bool:
    wanted = f"{_TOKEN}={token}".encode()
    try:
        return wanted in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except FileNotFoundError:
        listing = subprocess.run(["ps", "-E", "-o", "command=", "-p", str(pid)], capture_output=True, check=False)
        return wanted in listing.stdout.split()


def _exit_text(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


_BOOT: Final = Path("/proc/sys/kernel/random/boot_id")
#: Index of the start time among the fields after the program's name in /proc/PID/stat.
_STARTED: Final = 19


def start_time(pid: int) -> str:
    """Return the start time of a process with the id of the boot; "" if there is no such process."""
    with contextlib.suppress(OSError, IndexError):
        words = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        return f"{words[_STARTED]} {_BOOT.read_text().strip()}"
    if _BOOT.exists():
        return ""
    listing = subprocess.run(["ps", "-o", "lstart=", "-p", str(pid)], capture_output=True, text=True, check=False)
    return " ".join(listing.stdout.split())
