"""Versions of libraries as Python's own look-up finds them, and imports without the garbage collector."""

from __future__ import annotations

import gc
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

from graspd.service.model import libraries
from graspd.service.model.libraries import _distributions, imports, own_process, version_of


def test_a_version_is_that_of_the_distribution() -> None:
    for library in ("numpy", "fast-simplification", "pydantic_settings"):
        assert version_of.__wrapped__(library) == version(library)
    with pytest.raises(PackageNotFoundError):
        version_of("no-such-library-of-graspd")


def test_the_first_place_counts_and_doubts_are_left_to_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("one/My.Library-1.0.dist-info", "two/my_library-2.0.dist-info", "two/my_library-3.0.dist-info"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "METADATA").write_text(f"Name: my-library\nVersion: {folder[-13:-10]}\n")
    _distributions.cache_clear()
    monkeypatch.setattr("sys.path", [str(tmp_path / "none"), str(tmp_path / "one"), str(tmp_path / "two")])
    assert version_of.__wrapped__("my-library") == "1.0"
    monkeypatch.setattr("sys.path", [str(tmp_path / "two")])
    assert version_of.__wrapped__("my-library") == version("my-library")
    _distributions.cache_clear()


@pytest.fixture(autouse=True)
def collects() -> object:
    gc.enable()
    yield
    gc.enable()


def test_nothing_is_collected_while_modules_come_even_if_one_fails() -> None:
    with imports():
        with imports():
            pass
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ModuleNotFoundError), imports():
        import no_such_module  # type: ignore[import-not-found]  # noqa: F401
    assert gc.isenabled()


def test_a_caller_who_collects_himself_goes_on_so() -> None:
    gc.disable()
    with imports():
        pass
    assert not gc.isenabled()


def test_only_a_process_of_graspd_s_own_keeps_what_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    frozen: list[bool] = []
    monkeypatch.setattr(gc, "freeze", lambda: frozen.append(True))
    monkeypatch.setattr(libraries, "_ours", False)
    with imports():
        pass
    assert not frozen
    own_process()
    with imports():
        pass
    assert frozen


def test_the_command_line_is_such_a_process() -> None:
    code = (
        "import gc, sys; sys.argv = ['graspd', 'jobs', '--help']; import graspd.cli\n"
        "try: graspd.cli.main()\nfinally: print(gc.get_freeze_count() > 0, gc.isenabled(), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.split() == ["True", "True"]
