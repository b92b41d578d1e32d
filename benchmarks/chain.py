"""What a valid grasp costs from the planner to its row in the shard, of two checkouts in one run; prints Markdown.

usage: python -m benchmarks.chain BEFORE AFTER DATA_DIR [--grasps 64] [--pairs allegro:mug shadow:bottle] [--json OUT]

BEFORE and AFTER are checkouts of graspd; DATA_DIR holds hands/. Each stage is run by one thread and timed by processor
time: other programs on the machine change the ratios little. Nothing is stored or sent: that part is in
docs/results/service.md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

#: Runs in each checkout, so it uses only what both have.
CHILD: Final = """
import json, sys, time
from dataclasses import replace
import numpy as np
from service.model.domain import FIDELITIES
from worker.hands.load import hand_from_path
from worker.objects.prepare import object_from_path
from worker.planners import Run, Wanted
from worker.planners.fast_graspd import planner
from worker.quality.postures import pregrasp, squeeze
from worker.quality.referee.decomposition import decompose
from worker.quality.referee.displacement import simulated_displacement_cm
from worker.quality.referee.judge import judge
from worker.quality.table import measure

path, name, count, seed = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
fidelity, run, spent = FIDELITIES["standard"], Run(threads=1), {}
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
    verdicts = timed("referee", lambda: judge(hand, obj, grasps, pieces=pieces, run=run))
    held = grasps.take(np.flatnonzero(verdicts.success == 1))
    timed("quality", lambda: measure(hand, obj, held, run=run))
    timed("displacement", lambda: simulated_displacement_cm(hand, obj, held.grasp, pieces=pieces, run=run))
    return len(held)

chain(Wanted(4, fidelity, seed=seed + 1))
spent.clear()
valid = sum(chain(Wanted(32, fidelity, seed, batch)) for batch in range(count // 32))
print(json.dumps({"valid": valid, "raw": count // 32 * 32, "ms": {stage: 1e3 * s for stage, s in spent.items()}}))
"""


def environment_of(root: Path) -> dict[str, str]:
    """The surroundings in which a program uses the code of a checkout, whatever is installed."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("GRASPD_")}
    return environment | {"PYTHONPATH": str(root)}


def run(root: Path, *arguments: str) -> dict[str, Any]:
    """The numbers of one checkout; ends the program if it fails."""
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
    """One line of the table: milliseconds of a core for a valid grasp."""
    return f"| {stage} | {before:.1f} | {after:.1f} | {before / after:.2f} |"


def table(pair: str, before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """The stages of one pair; the planner makes raw grasps, so all is told of a valid one."""
    each = [{stage: ms / max(1, found["valid"]) for stage, ms in found["ms"].items()} for found in (before, after)]
    lines = [
        f"### {pair}: {before['valid']} and {after['valid']} of {before['raw']} hold", "",
        "| core-ms a valid grasp | before | after | times |", "| --- | --- | --- | --- |",
    ]  # fmt: skip
    lines += [row(stage, each[0][stage], each[1][stage]) for stage in each[0]]
    totals = [sum(found.values()) for found in each]
    rest = [total - found["planner"] for total, found in zip(totals, each, strict=True)]
    return [*lines, row("all but the planner", *rest), row("all", *totals), ""]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--grasps", type=int, default=64, help="raw grasps of each pair, in batches of 32")
    parser.add_argument("--pairs", nargs="*", default=["allegro:mug", "shadow:bottle"])
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    found: dict[str, Any] = {}
    for number, pair in enumerate(given.pairs):
        hand, obj = pair.split(":")
        (urdf, *_) = sorted((given.data / "hands" / hand).glob("*.urdf"))
        arguments = (str(urdf.resolve()), obj, str(given.grasps), str(100 + number))
        both = [run(root.resolve(), *arguments) for root in (given.before, given.after)]
        found[pair] = dict(zip(("before", "after"), both, strict=True))
        sys.stdout.write("\n".join(table(pair, *both)) + "\n")
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
