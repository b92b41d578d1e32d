"""Settings of a command that plans itself, read without their library where none is set."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from graspd.service.cli import EngineSettings, engine_settings, load_settings
from graspd.service.model.errors import InputError


@pytest.fixture(autouse=True)
def nothing_set(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.upper().startswith("GRASPD_")]:
        monkeypatch.delenv(name)


def test_where_nothing_is_set_they_are_the_defaults_and_nothing_is_loaded() -> None:
    whole = load_settings()
    assert engine_settings() == EngineSettings(whole.prefilter, whole.processes)
    code = "import sys; from graspd.service.cli import engine_settings; engine_settings(); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pydantic_settings" not in done.stdout.split()


def test_what_is_set_counts_and_a_bad_value_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("graspd_processes", "3")
    assert engine_settings() == EngineSettings("auto", 3)
    monkeypatch.setenv("GRASPD_PREFILTER", "perhaps")
    with pytest.raises(InputError, match="GRASPD_PREFILTER"):
        engine_settings()
