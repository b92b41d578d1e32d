"""Warp as it is started: its default device belongs to the thread that sets it."""

from __future__ import annotations

import threading

from graspd.worker.engines import backend
from tests.waiting import PATIENCE_S


def test_the_default_device_of_one_thread_is_not_that_of_another() -> None:
    backend.start()
    from warp._src.context import runtime  # noqa: TID251 (what backend.py changes)

    first, seen, set_, looked = runtime.default_device, [], threading.Event(), threading.Event()

    def other() -> None:
        runtime.default_device = "a GPU"
        set_.set()
        looked.wait(PATIENCE_S)
        seen.append(runtime.default_device)

    thread = threading.Thread(target=other)
    thread.start()
    assert set_.wait(PATIENCE_S)
    assert runtime.default_device is first
    runtime.default_device = "the CPU"
    looked.set()
    thread.join()
    runtime.default_device = first
    assert seen == ["a GPU"]
