"""Wheel and sdist: the same bytes twice, and a wheel that works outside the repository."""

import hashlib
import subprocess
import sys
import sysconfig
import tarfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from graspd.service.model.version import PACKAGE_VERSION
from tests.conftest import REPOSITORY
from tests.shell import completed

NO_BUILD = pytest.mark.skipif(find_spec("build") is None, reason="no `build`: pip install -e '.[release]'")
pytestmark = [pytest.mark.slow, NO_BUILD]
#: What a user does first, from files of the package alone: templates, built-in hands.
FIRST_STEPS = """
import pathlib, graspd, graspd.api.dashboard.rendering
from graspd import service
import graspd.service.index.index, graspd.service.store.library
assert str(pathlib.Path(graspd.__file__)).startswith({place!r}), graspd.__file__
index = service.index.index.Index("sqlite:///" + {place!r} + "/index.sqlite")
index.close()
from graspd.service.store.store import open_store
store = open_store("memory://")
service.store.library.publish_builtins(store)
assert len(list(service.store.library.stored_assets(store))) >= 6
"""


def made(folder: Path) -> dict[str, Path]:
    subprocess.run([sys.executable, REPOSITORY / "docker" / "dist.py", folder], check=True, capture_output=True)
    return {file.suffix: file for file in folder.iterdir()}


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return made(tmp_path_factory.mktemp("first"))


def test_two_builds_are_the_same_bytes(first: dict[str, Path], tmp_path: Path) -> None:
    second = made(tmp_path / "elsewhere")
    assert first.keys() == second.keys() == {".whl", ".gz"}
    for kind, file in first.items():
        assert file.name == second[kind].name
        assert hashlib.sha256(file.read_bytes()).digest() == hashlib.sha256(second[kind].read_bytes()).digest()


def test_the_sdist_holds_what_the_wheel_is_made_of(first: dict[str, Path]) -> None:
    with tarfile.open(first[".gz"]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "LICENSE", "graspd/cli.py"} <= names
    assert not any(name.startswith(("tests/", "benchmarks/")) for name in names)


def test_the_wheel_works_outside_the_repository(first: dict[str, Path], tmp_path: Path) -> None:
    """Installed by itself; its libraries are this environment's, which the next test holds against its extras."""
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "venv")], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "-q", "--no-deps", str(first[".whl"])], check=True)
    (packages,) = (tmp_path / "venv").glob("lib/*/site-packages")
    # Only the folder: the editable install of the repository there is in a .pth file, which is not read.
    (packages / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    subprocess.run([python, "-c", FIRST_STEPS.format(place=str(tmp_path))], cwd=tmp_path, check=True)
    assert "synth" in completed([tmp_path / "venv" / "bin" / "graspd", "--help"], cwd=tmp_path).stdout


def test_all_of_its_extras_can_be_installed_beside_it(first: dict[str, Path]) -> None:
    """pip resolves `wheel[all]` with what this environment has, in which the tests pass; nothing is fetched."""
    done = completed([sys.executable, "-m", "pip", "install", "--dry-run", "--no-index", f"{first['.whl']}[all]"])
    assert done.returncode == 0, done.stderr
    assert f"graspd-{PACKAGE_VERSION}" in done.stdout + done.stderr
