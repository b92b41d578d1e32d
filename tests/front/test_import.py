"""`import graspd` is light and complete."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import graspd
from tests.conftest import REPOSITORY

HEAVY = ("numpy", "pydantic", "warp", "newton", "trimesh", "mujoco", "h5py", "httpx")
#: All that it imports of its own: `libraries` imports the others without the garbage collector.
OWN = {"graspd", "graspd.service", "graspd.service.model", "graspd.service.model.libraries"}


def python(code: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=cwd)


def test_the_import_loads_nothing_that_takes_time() -> None:
    done = python("import graspd, sys; print(*sys.modules)", REPOSITORY)
    loaded = set(done.stdout.split())
    assert {name for name in loaded if name.partition(".")[0] == "graspd"} == OWN, done.stderr
    assert {name.partition(".")[0] for name in loaded}.isdisjoint(HEAVY)


def test_every_public_name_is_there() -> None:
    assert [name for name in graspd.__all__ if getattr(graspd, name, None) is None] == []


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = graspd.no_such_name


def test_the_errors_are_one_tree() -> None:
    named = [getattr(graspd, name) for name in graspd.__all__ if name.endswith("Error")]
    assert all(issubclass(one, graspd.GraspdError) for one in named)
