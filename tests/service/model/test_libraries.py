"""Versions of libraries are those that Python's own look-up finds."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

from service.model.libraries import _distributions, version_of


@pytest.mark.parametrize(
    "library",
    ["numpy", "scipy", "manifold3d", "fast-simplification", "coacd", "pydantic_settings"],
)
def test_a_version_is_that_of_the_distribution(library: str) -> None:
    assert version_of.__wrapped__(library) == version(library)


def test_what_is_not_installed_has_none() -> None:
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
