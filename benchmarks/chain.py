"""Cost of a valid grasp from planner to shard row, for two checkouts in one run; prints Markdown.

usage: python -m benchmarks.chain BEFORE AFTER DATA_DIR [--grasps 64] [--pairs allegro:mug shadow:bottle] [--json OUT]
       python -m benchmarks.chain BEFORE AFTER --service [--pictures] [--job JSON] [--after JSON] [--grasps 256] [...]

BEFORE and AFTER are checkouts of graspd; DATA_DIR holds hands/. One thread runs each stage. Times are processor time,
so other load changes the ratios little. Nothing is stored or sent: docs/results/service.md has these costs.

With --service, a job of a built-in hand and object runs through a whole service of each checkout: submitted over HTTP,
planned, validated, measured, stored, indexed. A small untimed job first fills the caches. Processor time is that of all
processes of the service. With --pictures, jobs have the options of examples/million/million.toml: eight rechecks, and
per batch six pictures of the object at rest on a table. Version 0.2 gives every object a mass of 0.1 kg: for
comparisons with it, use `--after '{"mass": 0.1}'`. `--job '{"scene": "table", "scenes": 4}'` plans on tables.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Final

#: Program for each checkout; it uses the names of this checkout, or those of graspd 0.2.
CHILD: Final = """
import json, sys, time
import numpy as np
try:
    from graspd.service.model.domain import JobOptions
    from graspd.worker.execution_context import ExecutionContext
    from graspd.worker.hands.load import hand_from_path
    from graspd.worker.objects.prepare import object_from_path
    from graspd.worker.planners.fast_graspd import planner
    from graspd.worker.planners.port import PlanRequest
    from graspd.worker.quality.table import measure
    from graspd.worker.validation.decomposition import decompose
    from graspd.worker.validation.displacement import simulated_displacement_cm
    from graspd.worker.validation.validator import validate
except ImportError:  # a checkout of 0.2
    from service.model.domain import JobOptions
    from worker.hands.load import hand_from_path
    from worker.objects.prepare import object_from_path
    from worker.planners import Run as ExecutionContext, Wanted as PlanRequest
    from worker.planners.fast_graspd import planner
    from worker.quality.referee.decomposition import decompose
    from worker.quality.referee.displacement import simulated_displacement_cm
    from worker.quality.referee.judge import judge as validate
    from worker.quality.table import measure

path, name, count, seed = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
fidelity, run, spent = JobOptions(fidelity="standard").knobs, ExecutionContext(threads=1), {}
hand, obj = hand_from_path(path), object_from_path(name, face_error_m=fidelity.face_error_m)
pieces = decompose(obj)

def timed(stage, work):
    began = time.process_time()
    made = work()
    spent[stage] = spent.get(stage, 0.0) + time.process_time() - began
    return made

def chain(wanted):
    parts = timed("planner", lambda: planner.optimise_batch(hand, obj, wanted, run))
    states = [part.state for part in parts]
    grasps = timed("postures", lambda: planner.grasps_of(hand, obj, parts, 0.0))
    verdicts = timed("validator", lambda: validate(hand, obj, grasps, pieces=pieces, run=run))
    held = grasps.take(np.flatnonzero(verdicts.success == 1))
    timed("quality", lambda: measure(hand, obj, held, run=run))
    timed("displacement", lambda: simulated_displacement_cm(hand, obj, held.grasp, pieces=pieces, run=run))
    return len(held)

chain(PlanRequest(4, fidelity, seed=seed + 1))
spent.clear()
valid = sum(chain(PlanRequest(32, fidelity, seed, batch)) for batch in range(count // 32))
candidates = count // 32 * 32
ms = {stage: 1e3 * s for stage, s in spent.items()}
print(json.dumps({"valid": valid, "candidates": candidates, "ms": ms}))
"""


#: Options of the pilot's jobs besides the number of grasps.
PILOT: Final = {"scenes": 2, "views": 3, "rechecks": 8, "budget": 4}


def environment_of(root: Path) -> dict[str, str]:
    """Return an environment in which a program uses the code of a checkout, not the installed one."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("GRASPD_")}
    # Allow bytecode caches, as users do; without them each process would compile all modules.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    return environment | {"PYTHONPATH": str(root)}


def run(root: Path, *arguments: str) -> dict[str, Any]:
    """Return the numbers of one checkout; end the program if the run fails."""
    done = subprocess.run(
        [sys.executable, "-c", CHILD, *arguments],
        cwd=root,
        env=environment_of(root),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(f"{root}: {done.stderr[-2000:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def row(stage: str, before: float, after: float) -> str:
    """Return one line of the table: core-ms per valid grasp."""
    return f"| {stage} | {before:.1f} | {after:.1f} | {before / after:.2f} |"


def table(pair: str, before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Return the stages of one pair; costs are per valid grasp."""
    each = [{stage: ms / max(1, found["valid"]) for stage, ms in found["ms"].items()} for found in (before, after)]
    lines = [
        f"### {pair}: {before['valid']} of {before['candidates']} candidates hold before, {after['valid']} after",
        "",
        "| core-ms per valid grasp | before | after | before / after |",
        "| --- | --- | --- | --- |",
    ]
    lines += [row(stage, each[0][stage], each[1][stage]) for stage in each[0]]
    totals = [sum(found.values()) for found in each]
    rest = [total - found["planner"] for total, found in zip(totals, each, strict=True)]
    return [*lines, row("all but the planner", *rest), row("all", *totals), ""]


def through_service(root: Path, hand: str, obj: str, grasps: int, wanted: dict[str, Any]) -> dict[str, float]:
    """Run a job; return its number of valid grasps, and the wall and processor time of the service."""
    from benchmarks.service_of import service_of  # it imports this module

    with service_of(root) as service:
        service.job(hand=hand, object=obj, grasps=8, seed=1, **wanted)
        spent, began = service.processor_s(), time.perf_counter()
        job = service.job(hand=hand, object=obj, grasps=grasps, seed=2, **wanted)
        wall = time.perf_counter() - began
        return {"valid": job["valid"], "wall": wall, "processor": service.processor_s() - spent}


def service_table(pair: str, before: dict[str, float], after: dict[str, float]) -> list[str]:
    """Return the rates and costs of both jobs, and their ratios."""
    rates = [found["valid"] / found["wall"] for found in (before, after)]
    costs = [1e3 * found["processor"] / found["valid"] for found in (before, after)]
    return [
        f"### {pair}: {before['valid']:.0f} valid grasps before, {after['valid']:.0f} after",
        "",
        "| through the service | before | after | ratio |",
        "| --- | --: | --: | --: |",
        f"| valid grasps/s | {rates[0]:.2f} | {rates[1]:.2f} | {rates[1] / rates[0]:.2f} |",
        row("core-ms per valid grasp", *costs),
        "",
    ]


def compare_services(given: argparse.Namespace) -> dict[str, Any]:
    """Run jobs of all pairs through both services, one after the other."""
    found: dict[str, Any] = {}
    for pair in given.pairs:
        hand, obj = pair.split(":")
        wanted = given.job | (PILOT if given.pictures else {})
        both = [
            through_service(root.resolve(), hand, obj, given.grasps or 256, wanted | more)
            for root, more in ((given.before, {}), (given.after, given.after_job))
        ]
        found[pair] = dict(zip(("before", "after"), both, strict=True))
        sys.stdout.write("\n".join(service_table(pair, *both)) + "\n")
        sys.stdout.flush()
    return found


def compare_stages(given: argparse.Namespace) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for number, pair in enumerate(given.pairs):
        hand, obj = pair.split(":")
        (urdf, *_) = sorted((given.data / "hands" / hand).glob("*.urdf"))
        arguments = (str(urdf.resolve()), obj, str(given.grasps or 64), str(100 + number))
        both = [run(root.resolve(), *arguments) for root in (given.before, given.after)]
        found[pair] = dict(zip(("before", "after"), both, strict=True))
        sys.stdout.write("\n".join(table(pair, *both)) + "\n")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("data", type=Path, nargs="?")
    parser.add_argument("--service", action="store_true", help="jobs through the whole service")
    parser.add_argument("--pictures", action="store_true", help="with --service: also pictures, as in the pilot")
    parser.add_argument("--job", type=json.loads, default={}, help="with --service: further options of the jobs")
    parser.add_argument("--after", dest="after_job", type=json.loads, default={}, help="the same, for AFTER only")
    parser.add_argument("--grasps", type=int, help="grasps of each pair, a multiple of 32; default: 64; --service: 256")
    parser.add_argument("--pairs", nargs="*", default=["allegro:mug", "shadow:bottle"])
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    if not given.service and given.data is None:
        parser.error("without --service, DATA_DIR is needed")
    found = compare_services(given) if given.service else compare_stages(given)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
