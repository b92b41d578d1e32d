"""Child process of a reader of untrusted files, with the environment that it needs and no credentials."""

import os
import signal
import subprocess
import sys
from typing import Final

#: Wall time limit [s], which ends a child that waits without computing.
_WALL_LIMIT_S: Final = 1800.0
_PASSED_ON: Final = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH")
#: Each thread takes address space, which is limited.
_ONE_THREAD: Final = dict.fromkeys(("PXR_WORK_THREAD_LIMIT", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")


def run_isolated(module: str, *arguments: str, data: bytes = b"", what: str) -> bytes:
    """Run a module with `data` on its standard input; return its output, cut off if the child crashed.
    Raises OSError: the child was killed or hung; `what` is the file in the message."""
    passed_on = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    try:
        done = subprocess.run(
            [sys.executable, "-m", module, *arguments],
            input=data,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=_WALL_LIMIT_S,
            check=False,
            env={**passed_on, **_ONE_THREAD, "PYTHONHASHSEED": "0"},
        )
    except subprocess.TimeoutExpired:
        raise TimeoutError(f"{what}: reading it did not end in {_WALL_LIMIT_S:.0f} s; try again") from None
    if done.returncode == -signal.SIGKILL:
        raise OSError(f"reading {what} was killed; the machine may lack memory")
    return done.stdout
