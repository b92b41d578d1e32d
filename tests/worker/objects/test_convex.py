"""What ends a decomposition: too much work is the mesh's, a killed child the machine's."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from graspd.worker.objects.convex import WorkLimitExceeded, coacd_parts

_CORNERS, _FACES = np.eye(4, 3), np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])


def ending(code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The child does this instead."""
    run = subprocess.run

    def other(command: list[str], **options: object) -> object:
        return run([sys.executable, "-c", f"import os, signal\n{code}"], **options)  # type: ignore[call-overload]

    monkeypatch.setattr("graspd.worker.objects.convex.subprocess.run", other)


def test_more_computing_than_it_may_is_too_much_work(monkeypatch: pytest.MonkeyPatch) -> None:
    endless = "import resource; resource.setrlimit(resource.RLIMIT_CPU, (1, 9))\nwhile True: pass"
    ending(endless, monkeypatch)
    with pytest.raises(WorkLimitExceeded, match="more than 1 s"):
        coacd_parts(_CORNERS, _FACES, {}, 1)


def test_a_child_that_was_killed_makes_no_other_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    ending("os.kill(os.getpid(), signal.SIGKILL)", monkeypatch)
    with pytest.raises(OSError, match="was killed"):
        coacd_parts(_CORNERS, _FACES, {}, 1)


def test_a_child_that_does_not_start_makes_no_other_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere")
    with pytest.raises(OSError, match="nowhere"):
        coacd_parts(_CORNERS, _FACES, {}, 1)
