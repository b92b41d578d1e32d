"""What the processes of a pool do in tests; imports next to nothing."""

import os
import signal
import time
from pathlib import Path


def times(shared: int, part: int) -> int:
    return shared * part


def own_pid(shared: object, part: object) -> int:
    return os.getpid()


def fail(shared: str, part: int) -> int:
    if part:
        raise ValueError(f"{shared} {part}")
    return part


def fail_oddly(shared: object, part: object) -> None:
    class Odd(Exception):
        """One that cannot be pickled."""

    raise Odd("very odd")


def be_killed(shared: object, part: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def hang(shared: Path, part: object) -> None:
    """Tells its pid in a file, and does not end."""
    (shared / f"{os.getpid()}").touch()
    while True:
        time.sleep(1)
