"""Names of compiled kernels, for what is kept of their results."""

from __future__ import annotations

from types import ModuleType

import warp as wp


def binary_name(module: ModuleType) -> str:
    """What the kernels of a module are compiled to on this CPU: a digest of their sources, of all they call and of how
    they are compiled, and the name that Warp gives the file, which tells the instructions that the CPU has.

    Two processes in which it is the same run the same instructions.
    """
    known = wp.get_module(module.__name__)
    # A launch on the CPU has blocks of one thread.
    name = known._get_compile_output_name(wp.get_device("cpu"), block_dim=1)
    return f"{wp.config.version} {known.get_module_hash(1).hex()} {name}"
