"""Where the service of a data folder answers: `graspd up` writes it down, clients on the same machine read it.

The record says which process wrote it. One whose process is gone is of a service that ended without a word: it is not
believed, and the next start replaces it.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from pathlib import Path
from typing import Final

from service.run.processes import start_of

_FILE: Final = "api.json"


def record_address(folder: Path, url: str) -> None:
    """Write down, for this user alone, that the service of this process answers at `url`; the file appears whole."""
    handle, name = tempfile.mkstemp(dir=folder, prefix=f".{_FILE}.")
    try:
        with os.fdopen(handle, "w") as file:
            json.dump({"api_url": url, "pid": os.getpid(), "started": start_of(os.getpid())}, file)
        Path(name).replace(folder / _FILE)
    except OSError:
        Path(name).unlink(missing_ok=True)
        raise


def forget_address(folder: Path) -> None:
    """Take the record away if this process wrote it."""
    record = _read(folder)
    if record is not None and record[1] == os.getpid():
        with contextlib.suppress(OSError):
            (folder / _FILE).unlink(missing_ok=True)


def recorded_address(folder: Path) -> str | None:
    """Where the service of a data folder answers; None if none was recorded, or the process that did so is gone."""
    record = _read(folder)
    return record[0] if record is not None and _lives(*record[1:]) else None


def _read(folder: Path) -> tuple[str, int, str] | None:
    try:
        file = folder / _FILE
        # A file of another user might send this one's key to a stranger.
        if file.stat().st_uid not in (os.getuid(), 0):
            return None
        record = json.loads(file.read_text())
        url, pid, started = record["api_url"], record["pid"], str(record.get("started", ""))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    known = isinstance(url, str) and url.startswith(("http://", "https://")) and isinstance(pid, int) and pid > 0
    return (url, pid, started) if known else None


def _lives(pid: int, started: str) -> bool:
    """Whether the process is there. A record of an older graspd does not say when it started."""
    if started:
        return start_of(pid) == started
    try:
        os.kill(pid, 0)
    except PermissionError:
        return True
    except (OSError, OverflowError):
        return False
    return True
