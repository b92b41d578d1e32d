"""Vendored files are what their lists say: name, version, licence, checksum. Nothing else lies beside them."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from graspd.api.dashboard.rendering import STATIC

FOLDERS = (STATIC / "vendor", Path(__file__).parents[2] / "browser" / "vendor")
#: What is bundled comes with the list of its parts.
SOURCES = {"three-entry.mjs"}
PERMISSIVE = {"MIT", "0BSD", "OFL-1.1", "Apache-2.0"}


@pytest.mark.parametrize("folder", FOLDERS, ids=["served", "for tests"])
def test_vendored_files_are_those_of_the_list(folder: Path) -> None:
    entries = json.loads((folder / "vendor.json").read_text())
    listed = {name: checksum for entry in entries for name, checksum in entry["files"].items()}
    assert {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in listed} == listed
    licences = {entry["licence_file"] for entry in entries}
    assert {path.name for path in folder.iterdir()} == {*listed, *licences, "vendor.json"} | (
        SOURCES if folder == FOLDERS[0] else set()
    )
    assert all((folder / name).stat().st_size > 200 for name in licences)


def test_what_users_are_served_is_licensed_permissively() -> None:
    entries = json.loads((FOLDERS[0] / "vendor.json").read_text())
    assert {entry["licence"] for entry in entries} <= PERMISSIVE
    assert all(entry["version"] and entry["made"] for entry in entries)
