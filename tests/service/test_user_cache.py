"""The user's cache: entries whole, intact and the user's own, wherever it can be written."""

import logging
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from graspd.service import user_cache


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    user_cache._cache_root.cache_clear()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def test_an_entry_is_read_as_it_was_kept(tmp_path: Path) -> None:
    file = tmp_path / "things" / "a.npz"
    assert user_cache.load(file) is None
    user_cache.store(file, b"first")
    user_cache.store(file, b"second")
    assert user_cache.load(file) == b"second"
    assert [found.name for found in file.parent.iterdir()] == ["a.npz"]


def test_a_damaged_or_foreign_entry_is_as_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "a.npz"
    user_cache.store(file, b"x" * 100)
    whole = file.read_bytes()
    for harmed in (whole[:-1], bytes([*whole[:60], whole[60] ^ 1, *whole[61:]]), b"", whole[:20]):
        file.write_bytes(harmed)
        assert user_cache.load(file) is None
    file.write_bytes(whole)
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert user_cache.load(file) is None


def test_the_longest_unused_entries_go_when_it_is_full(tmp_path: Path) -> None:
    for k in range(4):
        user_cache.store(tmp_path / f"{k}.npz", bytes(1000), limit_bytes=10_000)
        os.utime(tmp_path / f"{k}.npz", (k, k))
    user_cache.store(tmp_path / "new.npz", bytes(1000), limit_bytes=3200)
    assert sorted(file.name for file in tmp_path.glob("*.npz")) == ["2.npz", "3.npz", "new.npz"]
    user_cache.store(tmp_path / "large.npz", bytes(5000), limit_bytes=3200)
    assert [file.name for file in tmp_path.glob("*.npz")] == ["large.npz"]


def test_it_lies_where_the_environment_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert user_cache.cache_folder("objects") == tmp_path / "xdg" / "graspd" / "objects"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert user_cache.cache_folder("objects") == tmp_path / "home" / ".cache" / "graspd" / "objects"


@pytest.mark.parametrize("trouble", ["a file", "not writable"])
def test_a_home_that_cannot_be_written_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, trouble: str
) -> None:
    home = tmp_path / "home"
    if trouble == "a file":
        home.write_text("")
    else:
        # Root may write anywhere but on a read-only disk: what the system answers there.
        monkeypatch.setattr(os, "access", lambda path, _: not str(path).startswith(str(home)))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(home))
    with caplog.at_level(logging.WARNING):
        folders = {user_cache.cache_folder(name) for name in ("objects", "convex", "objects")}
    private = tmp_path / f"graspd-cache-{os.geteuid()}"
    assert folders == {private / "objects", private / "convex"}
    assert private.stat().st_mode & 0o777 == 0o700
    (line,) = caplog.messages
    assert str(home) in line and str(private) in line


def test_a_folder_that_others_can_write_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "home").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    planted = tmp_path / f"graspd-cache-{os.geteuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    file = user_cache.cache_folder("objects") / "a.npz"
    user_cache.store(file, b"x")
    assert user_cache.load(file) is None
    assert list(planted.iterdir()) == []


def test_processes_that_keep_one_entry_leave_a_whole_one(tmp_path: Path) -> None:
    write = (
        "import sys, pathlib; from graspd.service import user_cache\n"
        "for _ in range(200):\n"
        "    user_cache.store(pathlib.Path(sys.argv[1]), sys.argv[2].encode() * 50_000)\n"
        "    assert user_cache.load(pathlib.Path(sys.argv[1])) is not None, 'torn'\n"
    )
    file = tmp_path / "a.npz"
    running = [subprocess.Popen([sys.executable, "-c", write, str(file), letter]) for letter in "ab"]
    assert [process.wait() for process in running] == [0, 0]
    assert user_cache.load(file) in (b"a" * 50_000, b"b" * 50_000)
    assert list(tmp_path.iterdir()) == [file]
