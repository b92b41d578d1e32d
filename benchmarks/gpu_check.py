"""Check CUDA kernels without a GPU: registers, stack and spills of each kernel on each architecture.

usage: python -m benchmarks.gpu_check [--arch 80 --arch 90 --arch 100] [--json OUT]       (make gpu-check)

Warp compiles every module to PTX. `ptxas` (PyPI: nvidia-cuda-nvcc, the extra `gpu-check`) compiles it to machine code
and reports registers, stack and spilled bytes of each kernel. The exit code is 1 if a kernel spills or has a stack
above `STACK_BYTES`. It is also 1 if a hot kernel (one of every iteration) has more than `HOT_REGISTERS` registers."""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import warp as wp

from graspd.worker.engines.backend import ARCHITECTURES, kernel_modules

STACK_BYTES = 512
HOT_REGISTERS = 128
#: Registers of kernels that would spill with fewer: the 6 x 6 system and its factor stay in registers.
KNOWN = {("simulation.kernels.contact.direct", 100): 135}
#: Kernels that run in every iteration of the planner, and so determine the speed on a GPU.
HOT = ("gather", "object_in_pieces", "pieces_in_pieces", "direct", "obstacle")


@dataclass(frozen=True)
class Kernel:
    module: str
    name: str
    arch: int
    registers: int
    stack_bytes: int
    spilled_bytes: int

    @property
    def is_hot(self) -> bool:
        """Whether the kernel runs in every iteration."""
        return self.name.startswith(HOT)

    @property
    def faults(self) -> list[str]:
        found = [f"spills {self.spilled_bytes} bytes"] if self.spilled_bytes else []
        if self.stack_bytes > STACK_BYTES:
            found.append(f"has a stack of {self.stack_bytes} bytes")
        if self.is_hot and self.registers > KNOWN.get((f"{self.module}.{self.name}", self.arch), HOT_REGISTERS):
            found.append(f"takes {self.registers} registers")
        return found


def ptx_of(name: str, arch: int, folder: Path) -> Path:
    made = wp.compile_aot_module(import_module(name), arch=arch, module_dir=folder, use_ptx=True)
    return next(path for path in (made or sorted(folder.glob("*.ptx"))) if str(path).endswith(".ptx"))


def kernels(name: str, arch: int, assembler: Path) -> list[Kernel]:
    """Return the report of the assembler on a module's kernels."""
    with tempfile.TemporaryDirectory() as folder:
        path = ptx_of(name, arch, Path(folder))
        text = path.read_bytes().rstrip(b"\0")  # the assembler rejects the trailing NUL
        path.write_bytes(text)
        done = subprocess.run(
            [assembler, "-v", f"-arch=sm_{arch}", path, "-o", Path(folder) / "out.cubin"],
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        sys.exit(f"{name} for sm_{arch}: {done.stderr.strip()[:400]}")
    return list(_told(done.stderr, name, arch))


_ENTRY = re.compile(r"Compiling entry function '(\w+)'")
_FRAME = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads")
_USED = re.compile(r"Used (\d+) registers")


def _told(text: str, module: str, arch: int) -> Iterator[Kernel]:
    entry, stack, spilled = "", 0, 0
    for line in text.splitlines():
        if found := _ENTRY.search(line):
            entry, stack, spilled = found[1], 0, 0
        elif found := _FRAME.search(line):
            stack, spilled = int(found[1]), int(found[2]) + int(found[3])
        elif entry and (found := _USED.search(line)):
            # name_hash_cuda_kernel_forward
            name = re.sub(r"(_[0-9a-f]{8})?_cuda_kernel_(forward|backward)$", "", entry)
            yield Kernel(
                module.removeprefix("graspd.").removeprefix("worker."), name, arch, int(found[1]), stack, spilled
            )
            entry = ""


def ptxas() -> Path | None:
    """Return the path of the assembler in the installed wheel."""
    spec = find_spec("nvidia")
    places = list(spec.submodule_search_locations or []) if spec else []
    return next((path for place in places for path in Path(place).glob("**/bin/ptxas")), None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arch", type=int, action="append")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    wp.config.quiet = True
    assembler = ptxas()
    if assembler is None:
        sys.exit("gpu_check needs ptxas: pip install 'graspd[gpu-check]'")
    found: list[Kernel] = []
    for arch in given.arch or ARCHITECTURES:
        names = kernel_modules()
        # Warp's code generation holds Python's lock, but the assembler is a separate process.
        with ThreadPoolExecutor(2) as pool:
            for part in pool.map(lambda name, arch=arch: kernels(name, arch, assembler), names):
                found += part
    report(found)
    if given.json:
        given.json.write_text(json.dumps([asdict(kernel) for kernel in found], indent=1) + "\n")
    sys.exit(1 if any(kernel.faults for kernel in found) else 0)


def report(found: list[Kernel]) -> None:
    """Print a table of the largest kernels per architecture, and all faults."""
    print(
        f"{'architecture':14}{'kernels':>8}{'most registers':>16}{'of hot ones':>13}{'largest stack':>15}{'spills':>8}"
    )
    for arch in sorted({kernel.arch for kernel in found}):
        here = [kernel for kernel in found if kernel.arch == arch]
        print(
            f"sm_{arch:<11}{len(here):8}{max(k.registers for k in here):16}"
            f"{max((k.registers for k in here if k.is_hot), default=0):13}{max(k.stack_bytes for k in here):15}"
            f"{sum(k.spilled_bytes for k in here):8}"
        )
    for kernel in found:
        for fault in kernel.faults:
            print(f"sm_{kernel.arch} {kernel.module}.{kernel.name} {fault}")


if __name__ == "__main__":
    main()
