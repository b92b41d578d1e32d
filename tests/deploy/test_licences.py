"""Every package that graspd may run with has an accepted licence; and what `make gpu-check` reads."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import Distribution, PackageNotFoundError, distribution, metadata
from pathlib import Path
from types import ModuleType

import pytest

from benchmarks import gpu_check
from benchmarks.gpu_check import Kernel
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


def test_every_package_is_on_the_page_with_an_accepted_licence(licences: ModuleType) -> None:
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
    [({}, None), ({"spilled_bytes": 4}, "spills"), ({"stack_bytes": 513}, "stack"), ({"registers": 129}, "registers")],
)
def test_a_kernel_that_does_not_fit_is_named(change: dict[str, int], fault: str | None) -> None:
    faults = replace(FEASIBLE, **change).faults
    assert (faults == []) if fault is None else (fault in faults[0])


def test_a_kernel_that_runs_once_may_take_more_registers() -> None:
    assert replace(FEASIBLE, name="anneal", registers=200).faults == []


def test_every_kernel_of_the_planner_s_iteration_is_looked_for() -> None:
    assert {"graspd.worker.simulation.kernels.contact", "graspd.baselines.dfc.kernels"} <= set(gpu_check.modules())
