"""The failure table of ARCHITECTURE.md names tests that exist."""

from __future__ import annotations

import re

from tests.conftest import REPOSITORY


def test_every_fault_in_the_table_has_its_test() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", (REPOSITORY / "ARCHITECTURE.md").read_text())
    assert len(named) >= 15
    for file, test in named:
        assert f"def {test}" in (REPOSITORY / file).read_text(), f"{file}::{test}"
