"""Telemetry of each process: log lines, and a heartbeat file for health checks."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from graspd.service.model.errors import without_secrets

if TYPE_CHECKING:
    from graspd.service.settings import Settings

SUBJECTS: Final = ("request", "key", "job", "task", "attempt", "worker")
_bound: ContextVar[Mapping[str, Any]] = ContextVar("bound", default=MappingProxyType({}))
_ORDINARY: Final = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "about", "taskName"}
#: Loggers with too many lines: RQ logs every idle poll, httpx every request.
_TALKATIVE: Final = ("rq.worker", "rq.job", "rq.queue", "httpx")


@contextmanager
def bind_subjects(**subjects: Any) -> Iterator[None]:
    """Add non-empty subjects to the log lines of a `with` block, but not of threads started in it."""
    token = _bound.set({**_bound.get(), **{name: value for name, value in subjects.items() if value}})
    try:
        yield
    finally:
        _bound.reset(token)


def bound_subject(subject: str) -> str:
    return str(_bound.get().get(subject, ""))


def set_up_logs(settings: Settings, process: str = "graspd") -> None:
    """Write the log of this process to stderr; `process` is its name in JSON lines."""
    is_text = settings.log_format == "text" or (settings.log_format == "auto" and sys.stderr.isatty())
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_TextFormatter() if is_text else JsonFormatter(process))
    logging.basicConfig(level=settings.log_level.upper(), handlers=[handler], force=True)
    logging.captureWarnings(True)
    for name in _TALKATIVE:
        logging.getLogger(name).setLevel(logging.WARNING)


class JsonFormatter(logging.Formatter):
    """One JSON object per line: time, level, process, pid, logger, message, subjects, fields of `extra`."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "time": _format_time(record),
            "level": record.levelname,
            "process": self._process,
            "pid": os.getpid(),
            "logger": record.name,
            "message": record.getMessage(),
            **_subjects(record),
            **{name: value for name, value in vars(record).items() if name not in _ORDINARY and name not in SUBJECTS},
        }
        if record.exc_info:
            line["trace"] = self.formatException(record.exc_info)
        return without_secrets(json.dumps(line, default=str, ensure_ascii=False))


class _TextFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        about = " ".join(f"{name}={value}" for name, value in _subjects(record).items())
        trace = f"\n{self.formatException(record.exc_info)}" if record.exc_info else ""
        message = record.getMessage().translate(_OBEYED)
        text = f"{_format_time(record)[11:23]} {record.levelname} {record.name} {message}"
        return without_secrets(f"{text} [{about}]{trace}" if about else f"{text}{trace}")


#: Characters that end a line or control a terminal; with them, foreign paths and names could forge lines.
_OBEYED: Final = {
    code: repr(chr(code))[1:-1]
    for code in (*range(0x20), *range(0x7F, 0xA0), 0x2028, 0x2029, *range(0x202A, 0x202F), *range(0x2066, 0x206A))
}


def _subjects(record: logging.LogRecord) -> dict[str, Any]:
    found = dict(_bound.get())
    found.update((name, vars(record)[name]) for name in SUBJECTS if name in vars(record))
    return {name: found[name] for name in SUBJECTS if found.get(name)}


def _format_time(record: logging.LogRecord) -> str:
    when = datetime.fromtimestamp(record.created, UTC)
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")


log = logging.getLogger(__name__)
#: Interval of updates [s], well below the minute after which a health check declares the process dead.
_EVERY_S: Final = 5.0


class HeartbeatFile:
    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._again = 0.0

    def touch(self) -> None:
        """Update the file at most every few seconds; after an error, log a warning and stop updates."""
        now = time.monotonic()
        if self._path is None or now < self._again:
            return
        self._again = now + _EVERY_S
        try:
            self._path.touch()
        except OSError as error:
            log.warning("health checks will miss this process: %s cannot be touched (%s)", self._path, error.strerror)
            self._path = None
