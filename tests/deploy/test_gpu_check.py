"""What `make gpu-check` reads of the assembler, and what it objects to."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks import gpu_check
from benchmarks.gpu_check import Kernel

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
