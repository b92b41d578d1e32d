"""Several workers of one machine by one command: each a process of its own, started again when it ends."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from typing import Final

from service.run.children import Child
from service.settings import Settings

_WATCH_S: Final = 0.1


def run_workers(
    count: int,
    arguments: Sequence[str],
    settings: Settings,
    stop: threading.Event,
    *,
    program: Sequence[str] = (sys.executable, "-m", "graspd"),
) -> None:
    """Keep `count` workers alive until told to stop; number k of them takes the k-th GPU, see `worker.engines.gpus`.

    Args:
        arguments: command line of each; their settings come from the environment as well.
        settings: how long a worker may take to stop.
        stop: set by whoever ends it all.
    """
    of_each = [{"GRASPD_WORKER_NUMBER": str(number), "GRASPD_WORKERS_HERE": str(count)} for number in range(count)]
    children = [Child(f"worker-{number}", (*program, *arguments), own, None) for number, own in enumerate(of_each)]
    try:
        for child in children:
            child.start()
        while not stop.wait(_WATCH_S):
            for child in children:
                child.watch()
    finally:
        for child in children:
            child.ask_to_stop()
        deadline = time.monotonic() + settings.stop_grace_s
        for child in children:
            child.join(deadline)
