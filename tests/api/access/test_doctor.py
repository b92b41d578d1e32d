"""Keys as the doctor sees them."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import pytest

from graspd.api.access.doctor import keys
from graspd.api.access.keys import KeyFile, Scope
from graspd.service.run.doctor.checks import Condition
from graspd.service.settings import Settings


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path, host="0.0.0.0")


def test_without_keys_only_this_machine_is_served(settings: Settings, tmp_path: Path) -> None:
    found = keys(settings)
    assert not found.ok
    assert found.fix == "graspd keys add admin --scope admin"
    assert keys(Settings(data_dir=tmp_path)).condition is Condition.GOOD
    KeyFile(settings.resolved_keys_file).add("admin", Scope.ADMIN)
    assert keys(settings).condition is Condition.GOOD


def test_keys_that_end_soon_are_named_unless_they_were_rotated(settings: Settings) -> None:
    file = KeyFile(settings.resolved_keys_file)
    file.add("admin", Scope.ADMIN)
    file.add("robot", Scope.SUBMIT, lifetime=timedelta(days=2))
    found = keys(settings)
    assert found.condition is Condition.WARNING
    assert found.fix == "graspd keys rotate robot --grace 24h"
    file.rotate("robot", grace=timedelta(hours=24))
    assert keys(settings).condition is Condition.GOOD


def test_a_service_that_no_key_opens_is_bad(settings: Settings) -> None:
    file = KeyFile(settings.resolved_keys_file)
    file.add("admin", Scope.ADMIN)
    file.revoke("admin")
    assert not keys(settings).ok
    file.add("alice", Scope.SUBMIT)
    assert keys(settings).condition is Condition.WARNING, "nobody is admin"


def test_a_file_that_everybody_reads_or_nobody_can_is_bad(settings: Settings) -> None:
    KeyFile(settings.resolved_keys_file).add("admin", Scope.ADMIN)
    settings.resolved_keys_file.chmod(0o644)
    assert "chmod 600" in keys(settings).fix
    settings.resolved_keys_file.write_text("{")
    found = keys(settings)
    assert not found.ok
    assert str(settings.resolved_keys_file) in found.message
