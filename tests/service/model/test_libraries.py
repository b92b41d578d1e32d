"""Imports without the garbage collector."""

from __future__ import annotations

import gc
import subprocess
import sys

import pytest

from graspd.service.model import libraries
from graspd.service.model.libraries import imports, own_process


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
