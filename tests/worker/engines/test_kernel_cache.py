"""Kernels are kept where Warp would keep them, or where this user can write."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from graspd.service import user_cache
from graspd.worker.engines.backend import kernel_cache


@pytest.fixture
def blocked(tmp_path: Path) -> Path:
    """A folder that nobody can make, root neither: a file stands in its way."""
    (tmp_path / "file").write_text("")
    return tmp_path / "file" / "cache"


def test_a_folder_that_can_be_written_is_left_to_warp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "kernels"))
    assert kernel_cache() is None


def test_without_one_they_go_where_all_caches_of_this_user_go(
    blocked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("WARP_CACHE_PATH", str(blocked))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "mine"))
    assert kernel_cache() == tmp_path / "mine" / "graspd" / "warp" == user_cache.folder("warp")
    assert str(blocked) in caplog.text


def test_warp_starts_where_no_folder_of_the_user_can_be_written(blocked: Path, tmp_path: Path) -> None:
    (tmp_path / "tmp").mkdir()
    places = {
        "HOME": str(blocked),
        "XDG_CACHE_HOME": "",
        "WARP_CACHE_PATH": str(blocked),
        "TMPDIR": str(tmp_path / "tmp"),
    }
    code = (
        "from graspd.worker.engines import backend; backend.start(); import warp; print(warp.config.kernel_cache_dir)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **places}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(tmp_path / "tmp"))
    assert "Traceback" not in done.stderr
