"""The file of an SQLite index: which one it is, and how one that is gone or damaged gives way to a new one."""

from __future__ import annotations

import fcntl
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from service.model.errors import IndexUnavailable

log = logging.getLogger(__name__)
#: What SQLite keeps beside the file while it is open: the log of writes and its shared memory.
_COMPANIONS: Final = ("-wal", "-shm")
Identity = tuple[int, int] | None


class SqliteFile:
    """Processes that open the file take turns, so that none meets what another is putting aside."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def identity(self) -> Identity:
        """Device and inode of the file that has the name now; None if there is none.

        A process that holds a file which was removed would read and write what nobody else sees.
        """
        try:
            facts = self.path.stat()
        except FileNotFoundError:
            return None
        return facts.st_dev, facts.st_ino

    @contextmanager
    def opening(self) -> Iterator[None]:
        """Alone among processes. What a file that is gone left beside it is removed: it belongs to no other."""
        try:
            lock = self._beside(".lock").open("w")
        except OSError as error:
            raise IndexUnavailable(f"the index {self.path} cannot be opened: {error.strerror}") from None
        with lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if self.identity() is None:
                for name in _COMPANIONS:
                    self._beside(name).unlink(missing_ok=True)
            yield

    def set_aside(self, damaged: Identity) -> None:
        """Move a damaged file out of the way, unless another process did; call it within `opening`."""
        if damaged is None or self.identity() != damaged:
            return
        suffix = f".damaged-{datetime.now(UTC):%Y%m%dT%H%M%S}"
        log.error("the index %s is damaged and moved to %s%s; a new one takes its place", self.path, self.path, suffix)
        for name in ("", *_COMPANIONS):
            if (found := self._beside(name)).exists():
                found.rename(found.with_name(f"{self.path.name}{suffix}{name}"))

    def _beside(self, name: str) -> Path:
        return self.path.with_name(f"{self.path.name}{name}")
