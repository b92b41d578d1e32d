"""Warp as it is started: its default device belongs to the thread that sets it, and a release that is not known is left
as it is."""

from __future__ import annotations

import subprocess
import sys
import threading

from tests.waiting import PATIENCE_S
from worker.engines import backend


def test_the_default_device_of_one_thread_is_not_that_of_another() -> None:
    backend.start()
    from warp._src.context import runtime

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


OTHER = """
import sys
from worker.engines import backend
backend.KNOWN_WARP = "1.18.9"
backend.start()
from warp._src import codegen, context
assert "worker.engines.kept_hashes" not in sys.modules
print(context.ModuleHasher.__module__, codegen.Adjoint.extract_function_source.__module__)
"""


def test_a_release_of_warp_that_is_not_known_hashes_and_parses_its_own_way() -> None:
    done = subprocess.run([sys.executable, "-c", OTHER], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["warp._src.context", "warp._src.codegen"]
