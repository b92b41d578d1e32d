"""`import graspd` is light, complete, and says whose folder is in its way."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import graspd
from tests.conftest import REPOSITORY

HEAVY = ("numpy", "pydantic", "warp", "newton", "trimesh", "mujoco", "h5py", "httpx", "service", "worker", "api")
#: What imports the others without the garbage collector.
LIGHT = {"service", "graspd.service.model", "graspd.service.model.libraries"}


def python(code: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=cwd)


def test_the_import_loads_nothing_that_takes_time() -> None:
    done = python("import graspd, sys; print(*sys.modules)", REPOSITORY)
    loaded = set(done.stdout.split())
    assert "graspd" in loaded, done.stderr
    assert {name.partition(".")[0] for name in loaded - LIGHT}.isdisjoint(HEAVY)


def test_every_public_name_is_there() -> None:
    assert [name for name in graspd.__all__ if getattr(graspd, name, None) is None] == []


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = graspd.no_such_name


def test_the_errors_are_one_tree() -> None:
    named = [getattr(graspd, name) for name in graspd.__all__ if name.endswith("Error")]
    assert all(issubclass(one, graspd.GraspdError) for one in named)


@pytest.mark.parametrize("marker", ["__init__.py", None])
def test_a_folder_that_hides_one_of_graspds_own_is_named_in_one_line(tmp_path: Path, marker: str | None) -> None:
    hiding = tmp_path / "worker"
    hiding.mkdir()
    if marker:
        (hiding / marker).touch()
    # What stands first on the path wins, as beside a user's script; graspd itself is behind it.
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(REPOSITORY)!r}]; import graspd"
    done = python(code, tmp_path)
    if marker is None:  # a folder without __init__.py does not hide a package
        assert done.returncode == 0, done.stderr
        return
    said = f"{hiding} hides graspd's own package 'worker'; rename it, or start Python in another folder"
    assert done.stderr.strip().splitlines()[-1] == f"ImportError: graspd: {said}"
