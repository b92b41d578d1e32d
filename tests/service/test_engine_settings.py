"""What a command that plans itself reads of the settings, without the library that reads them where none is set."""

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


def test_where_nothing_is_set_they_are_the_defaults() -> None:
    whole = load_settings()
    assert engine_settings() == EngineSettings() == EngineSettings(whole.prefilter, whole.processes)


@pytest.mark.parametrize("name", ["GRASPD_PROCESSES", "graspd_processes"])
def test_what_is_set_counts(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, "3")
    assert engine_settings() == EngineSettings("auto", 3)


def test_a_bad_value_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRASPD_PREFILTER", "perhaps")
    with pytest.raises(InputError, match="GRASPD_PREFILTER"):
        engine_settings()


def test_nothing_is_loaded_for_settings_that_nobody_made() -> None:
    code = "import sys; from graspd.service.cli import engine_settings; engine_settings(); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pydantic_settings" not in done.stdout.split()
