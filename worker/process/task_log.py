"""Log of the running task: bounded, without secrets, sent while the task runs."""

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from graspd.service.model.errors import without_secrets

#: Limits on a log: its last lines are kept, and a long line is cut.
LINES: Final = 200
LINE_CHARACTERS: Final = 300
_SEND_EVERY_S: Final = 1.0


class TaskLog(logging.Handler):
    """Handler that keeps the last log lines of a running task, and lines about its progress."""

    def __init__(self, send: Callable[[str, str], None]) -> None:
        """`send` receives the task's RQ id and the whole log, at most once a second and at the end."""
        super().__init__()
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s %(message)s"))
        self._send, self._lines = send, deque[str](maxlen=LINES)
        self._task, self._due, self._noted = "", 0.0, ("", 0)

    @contextmanager
    def of_task(self, task: str) -> Iterator[None]:
        self._lines.clear()
        self._task, self._due, self._noted = task, 0.0, ("", 0)
        logging.getLogger().addHandler(self)
        try:
            yield
        finally:
            logging.getLogger().removeHandler(self)
            self._send(task, self.text())

    def emit(self, record: logging.LogRecord) -> None:
        self._lines.extend(line[:LINE_CHARACTERS] for line in without_secrets(self.format(record)).splitlines())
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + _SEND_EVERY_S
            self._send(self._task, self.text())

    def note_progress(self, done: float, total: float, message: str) -> None:
        """Add a line if the activity changed, or a further tenth of it is done."""
        share = done / total if total else 0.0
        if self._noted != (noted := (message, int(10 * share))):
            self._noted = noted
            self.handle(logging.LogRecord("progress", logging.INFO, "", 0, f"{share:.0%} {message}", None, None))

    def text(self) -> str:
        return "\n".join(self._lines)
