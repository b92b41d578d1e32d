"""Which process a pid meant: the system gives the number of one that ended to another."""

from __future__ import annotations

import contextlib
import subprocess
from pathlib import Path
from typing import Final

_BOOT: Final = Path("/proc/sys/kernel/random/boot_id")
#: Place of the start time among the words after the name of a program in /proc/PID/stat.
_STARTED: Final = 19


def start_of(pid: int) -> str:
    """When a process started: no two with one pid give the same text. "" if there is no such process."""
    with contextlib.suppress(OSError, IndexError):
        # A name of a program may hold blanks and brackets.
        words = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        return f"{words[_STARTED]} {_BOOT.read_text().strip()}"
    if _BOOT.exists():
        return ""
    said = subprocess.run(["ps", "-o", "lstart=", "-p", str(pid)], capture_output=True, text=True, check=False)
    return " ".join(said.stdout.split())
