"""Every package that graspd may run with has a known and accepted licence, listed in docs/reference/licences.md."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution, metadata
from pathlib import Path
from types import ModuleType

import pytest

from tests.conftest import REPOSITORY


@pytest.fixture(scope="module")
def licences() -> Iterator[ModuleType]:
    """docker/licences.py, which writes the page."""
    sys.path.insert(0, str(REPOSITORY / "docker"))
    try:
        yield importlib.import_module("licences")
    finally:
        sys.path.pop(0)


def _is_installed(name: str) -> bool:
    try:
        return bool(distribution(name))
    except PackageNotFoundError:
        return False


def test_every_package_is_on_the_page_with_a_licence_that_is_accepted(licences: ModuleType) -> None:
    wanted = [one for one in licences.pin.requirements(*licences.EXTRAS) if _is_installed(one.name)]
    rows = dict(
        line.strip("| ").split(" | ") for line in licences.PAGE.read_text().splitlines() if line.startswith("| ")
    )
    wrong = {
        name: licence
        for name in licences.pin.closure(wanted)
        if name != "graspd"
        and (
            not licences.is_accepted(licence := licences.licence_of(name, metadata(name))) or rows.get(name) != licence
        )
    }
    assert not wrong, "run `make licences`"


@pytest.mark.parametrize(
    ("said", "accepted"),
    [
        ("License-Expression: MIT", True),
        ("License: MIT", True),
        ("Classifier: License :: OSI Approved :: BSD License", True),
        ("License-Expression: GPL-3.0-only OR MIT", True),
        ("License-Expression: GPL-3.0-only AND MIT", False),
        ("License-Expression: AGPL-3.0-or-later", False),
        ("Classifier: License :: OSI Approved :: GNU General Public License v3 (GPLv3)", False),
        ("License: Proprietary", False),
        ("Summary: says nothing", False),
    ],
)
def test_what_is_not_known_to_be_permissive_is_not_accepted(
    licences: ModuleType, said: str, accepted: bool, tmp_path: Path
) -> None:
    (tmp_path / "METADATA").write_text(f"Metadata-Version: 2.4\nName: thing\nVersion: 1\n{said}\n")
    found = licences.licence_of("thing", Distribution.at(tmp_path).metadata)
    assert licences.is_accepted(found) is accepted
