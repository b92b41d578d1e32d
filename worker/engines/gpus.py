"""Which GPU a process takes where nobody names one, so that several of one machine take different ones.

`CUDA_VISIBLE_DEVICES` says which there are: the driver shows no others. Of these, worker number k takes the k-th, round
and round; who has no number takes the one with the fewest processes. That is told by locks that the kernel drops with
the process, however it ends: lock n of a GPU is held by the n-th process on it. They lie in the user's cache, which the
containers of one machine share.
"""

from __future__ import annotations

import fcntl
import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

log = logging.getLogger(__name__)
#: Processes on one GPU that are counted; more make no difference.
_MOST: Final = 64
#: Locks of this process, until it ends.
_held: list[IO[bytes]] = []


@dataclass(frozen=True)
class Gpu:
    """A GPU that this process can see."""

    name: str
    """Of Warp: cuda:0, ..."""
    id: str
    """The same for every process and container of the machine."""
    model: str = ""


def take(gpus: Sequence[Gpu], folder: Path, *, number: int | None = None) -> Gpu:
    """One of the GPUs, at least one of which is given: that of worker `number`, else one with the fewest processes.

    It counts as taken until this process ends. Without a folder that can be written it is the first.
    """
    eligible = [gpus[number % len(gpus)]] if number is not None else list(gpus)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for place in range(_MOST):
            for gpu in eligible:
                if _lock(folder / f"{re.sub(r'[^A-Za-z0-9-]', '_', gpu.id)}.{place}.lock"):
                    if place:
                        log.info("%s (%s) is shared by %d processes", gpu.name, gpu.model, place + 1)
                    return gpu
    except OSError as error:
        log.warning("GPUs are not told apart: no locks can be kept in %s (%s)", folder, error.strerror)
    return eligible[0]


def _lock(file: Path) -> bool:
    """Whether this process got the lock of a file. Raises OSError where locks cannot be had at all."""
    opened = file.open("ab")
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        opened.close()
        return False
    except OSError:
        opened.close()
        raise
    _held.append(opened)
    return True
