"""Cost of the validator's levels, and their agreement with the unmodified DexGraspBench protocol.

usage: python -m benchmarks.validation_levels DATA_DIR [--work DIR] [--hands allegro ...] [--objects NAME ...]
           [--out FILE]
DATA_DIR holds hands/ and objects/. Prints Markdown; `--out` writes the same as JSON. Interrupted runs resume (see
cells.py). Valid grasps per second are for two cores: held grasps divided by half the CPU time."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cells import cell_parser, cells, write_json
from graspd.worker.quality.intervals import wilson_interval

CORES = 2
LEVELS = ("dexgraspbench", "standard", "fast")


def row(found: list[dict[str, Any]], dexgraspbench: np.ndarray) -> dict[str, Any]:
    held = np.concatenate([np.array(f["success"]) for f in found]) == 1
    agree = int((held == dexgraspbench).sum())
    cpu = sum(f["cpu_seconds"] for f in found)
    return {
        "n": len(held),
        "held": float(held.mean()),
        "agreement": agree / len(held),
        "interval": [round(bound, 4) for bound in wilson_interval(agree, len(held))],
        "false_accepts": int((held & ~dexgraspbench).sum()),
        "false_rejects": int((~held & dexgraspbench).sum()),
        "cpu_ms_per_candidate": 1e3 * cpu / len(held),
        "valid_per_second": CORES * float(held.sum()) / cpu,
    }


def study(args: argparse.Namespace, hand: str, hard: bool) -> dict[str, Any]:
    found: dict[str, list[dict[str, Any]]] = {level: [] for level in LEVELS}
    objects = []
    for cell in cells(args.data, args.work, hand, args.grasps, args.objects):
        objects.append(cell.object_name)
        for level in LEVELS:
            found[level].append(cell.verdicts(level, hard))  # type: ignore[arg-type]
        sys.stderr.write(f"{hand}{' hard' if hard else ''}: {cell.object_name}\n")
    dexgraspbench = np.concatenate([np.array(f["success"]) for f in found["dexgraspbench"]]) == 1
    return {
        "hand": hand,
        "hard": hard,
        "objects": objects,
        "levels": {level: row(found[level], dexgraspbench) for level in LEVELS},
    }


def lines(one: dict[str, Any]) -> list[str]:
    out = []
    for level, r in one["levels"].items():
        low, high = (f"{100 * bound:.1f}" for bound in r["interval"])
        agreement = "" if level == "dexgraspbench" else f"{100 * r['agreement']:.1f} % ({low} to {high})"
        wrong = "" if level == "dexgraspbench" else f"{r['false_accepts']}, {r['false_rejects']}"
        out.append(
            f"| {one['hand']}{', hard' if one['hard'] else ''} | {level} | {r['n']} | {r['held']:.2f} | {agreement} "
            f"| {wrong} | {r['cpu_ms_per_candidate']:.0f} | {r['valid_per_second']:.0f} |"
        )
    return out


def main() -> None:
    parser = cell_parser(__doc__)
    parser.add_argument("--hard", action="store_true", help="also at half friction")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    sys.stdout.write(
        "| hand | level | candidates | held | agreement with dexgraspbench (95 %) | false accepts, false rejections "
        "| CPU ms per candidate | valid/s |\n"
        "| --- | --- | --: | --: | --: | --: | --: | --: |\n"
    )
    done = []
    for hand in args.hands:
        for hard in (False, True) if args.hard else (False,):
            done.append(study(args, hand, hard))
            sys.stdout.write("\n".join(lines(done[-1])) + "\n")
            sys.stdout.flush()
            if args.out:
                write_json(args.out, done)


if __name__ == "__main__":
    main()
