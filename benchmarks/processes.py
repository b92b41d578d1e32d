"""Cost of validation and quality table with threads and with processes; prints Markdown.

usage: python -m benchmarks.processes DATA_DIR [--grasps 256] [--hand allegro] [--object mug] [--ways 1t 2t 2p]

DATA_DIR holds hands/. A way is a number of threads (t) or processes (p). Candidates of a pair are planned once, then
validated and measured in each way, with running processes and compiled models. The table has wall and processor time
per candidate over all processes, and the memory of a process. It also shows whether results equal those of the first
way bit for bit.

`py-spy record -f raw`, with and without `--gil`, can record this program with `--ways 1t --only validate` or `table`.
The ratio of the samples is the share of time in which one thread holds Python's lock."""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from graspd.service.model.domain import BATCH_SIZE
from graspd.service.model.fidelity import FIDELITIES
from graspd.worker.grasps import GraspSet, join_grasp_sets
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import ExecutionContext, PlanRequest, synthesize
from graspd.worker.pool.pool import MODULES, Pool
from graspd.worker.quality.table import measure
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.validator import validate

#: Units of /proc: clock ticks and bytes.
_TICK_S: Final = 1 / os.sysconf("SC_CLK_TCK")
_FIELDS: Final = ("VmRSS", "RssAnon")


@dataclass(frozen=True)
class Trajectory:
    """A number of threads of this process, or of further processes."""

    name: str

    @property
    def number(self) -> int:
        return int(self.name[:-1])

    def told(self) -> str:
        what = "thread" if self.name.endswith("t") else "process"
        return f"{self.number} {what}{'' if self.number == 1 else 'es' if what == 'process' else 's'}"


def processor_s(pids: Sequence[int]) -> float:
    spent = time.process_time()
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        spent += (int(fields[11]) + int(fields[12])) * _TICK_S
    return spent


def memory_mib(pid: int) -> list[float]:
    """Return the resident memory of a process, and its part that is not backed by shared files [MiB]."""
    status = Path(f"/proc/{pid}/status").read_text()
    found = [re.search(rf"^{name}:\s+(\d+) kB", status, re.MULTILINE) for name in _FIELDS]
    return [int(one.group(1)) / 1024 for one in found if one is not None]


class Pair:
    """Candidates of a hand on an object, with functions that validate and measure them."""

    def __init__(self, data: Path, hand: str, obj: str, count: int) -> None:
        (urdf, *_) = sorted((data / "hands" / hand).glob("*.urdf"))
        fidelity = FIDELITIES["standard"]
        self.hand, self.obj = hand_from_path(str(urdf)), object_from_path(obj, face_error_m=fidelity.face_error_m)
        self.pieces = decompose(self.obj)
        batches = range(count // BATCH_SIZE)
        made = [synthesize(self.hand, self.obj, PlanRequest(BATCH_SIZE, fidelity, 19, batch)) for batch in batches]
        self.grasps: GraspSet = join_grasp_sets(made)

    def validated(self, run: ExecutionContext, grasps: GraspSet) -> dict[str, Any]:
        found = validate(self.hand, self.obj, grasps, pieces=self.pieces, run=run)
        return {name: getattr(found, name) for name in ("success", "outcome", "margin", "penetration_depth_mm")}

    def measured(self, run: ExecutionContext, grasps: GraspSet) -> dict[str, Any]:
        return measure(self.hand, self.obj, grasps, run=run)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--grasps", type=int, default=256)
    parser.add_argument("--hand", default="allegro")
    parser.add_argument("--object", default="mug")
    parser.add_argument("--ways", nargs="*", default=["1t", "2t", "2p"])
    parser.add_argument("--only", choices=["validate", "table"])
    given = parser.parse_args()
    pair = Pair(given.data, given.hand, given.object, given.grasps)
    parts = {"validate": pair.validated, "table": pair.measured}
    parts = {name: work for name, work in parts.items() if given.only in (None, name)}
    first: dict[str, dict[str, Any]] = {}
    heads = [f"{name}: {what} ms" for name in parts for what in ("wall", "core")]
    lines = ["| | " + " | ".join([*heads, "as by one thread", "MiB a process"]) + " |"]
    lines += ["| --- |" + " --: |" * (len(heads) + 2)]
    for way in map(Trajectory, given.ways):
        pool = Pool(way.number, MODULES) if way.name.endswith("p") else None
        run, cells, same = ExecutionContext(threads=way.number, pool=pool), list[str](), True
        for name, work in parts.items():
            work(run, pair.grasps.take(slice(0, 64)))
            pids = pool.pids if pool is not None else []
            began, spent = time.perf_counter(), processor_s(pids)
            made = work(run, pair.grasps)
            wall, core = time.perf_counter() - began, processor_s(pids) - spent
            cells += [f"{1e3 * seconds / len(pair.grasps):.1f}" for seconds in (wall, core)]
            known = first.setdefault(name, made)
            same &= all(np.array_equal(made[key], known[key], equal_nan=known[key].dtype.kind == "f") for key in known)
        told = [memory_mib(pid) for pid in pids] if pool is not None else [memory_mib(os.getpid())]
        resident, own = (max(column) for column in zip(*told, strict=True))
        cells += ["yes" if same else "NO", f"{resident:.0f}, {own:.0f} of them its own"]
        lines.append(f"| {way.told()} | " + " | ".join(cells) + " |")
        if pool is not None:
            pool.close()
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
