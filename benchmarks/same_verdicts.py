"""Verdicts of two checkouts on the same grasps, number by number, and what each costs; prints Markdown.

usage: python -m benchmarks.same_verdicts BEFORE AFTER DATA_DIR [--hands allegro barrett shadow] [--objects mug bottle]
                                          [--grasps 64] [--level standard]

BEFORE and AFTER are checkouts of graspd; AFTER plans the grasps. An object is a built-in one or a folder of
DATA_DIR/objects. A shortcut of the validator that moves no bit shows as many equal rows as there are grasps.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.chain import environment_of

#: Runs in each checkout, so it uses only what both have.
_COMMON: Final = """
import sys, time
import numpy as np
from graspd.service.model.domain import JobOptions
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.execution_context import Run

fidelity, run = JobOptions(fidelity="standard").knobs, Run(threads=1)
hand = hand_from_path(sys.argv[1])
obj = object_from_path(sys.argv[2], face_error_m=fidelity.face_error_m)
"""
PLAN: Final = f"""{_COMMON}
from graspd.worker.planners import Wanted, synthesize
grasps = synthesize(hand, obj, Wanted(int(sys.argv[4]), fidelity, seed=100), run)
parts = dict(grasp=grasps.grasp, pregrasp=grasps.pregrasp, squeeze=grasps.squeeze)
arrays = {{f"{{n}}_{{k}}": v for n, p in parts.items() for k, v in vars(p).items()}}
np.savez(sys.argv[3], loss=grasps.stability_loss, **arrays)
"""
VALIDATE: Final = f"""{_COMMON}
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.validator import validate
kept = np.load(sys.argv[3])
names = ("grasp", "pregrasp", "squeeze")
parts = {{n: Posture(kept[n + "_hand_pose"], kept[n + "_joint_positions"]) for n in names}}
grasps, pieces = GraspSet(**parts, stability_loss=kept["loss"]), decompose(obj)
began = time.process_time()
found = validate(hand, obj, grasps, level=sys.argv[5], pieces=pieces, run=run)
spent = time.process_time() - began
names = ("outcome", "margin", "penetration_depth_mm", "self_penetration_depth_mm")
np.savez(sys.argv[4], spent=spent, steps=found.steps, **{{name: getattr(found, name) for name in names}})
"""


def run(root: Path, code: str, *arguments: str) -> None:
    """Runs a program in a checkout; ends this one if it fails."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=root,
        env=environment_of(root),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(f"{root}: {done.stderr[-2000:]}")


def equal_rows(one: Any, other: Any, names: tuple[str, ...]) -> int:
    """Grasps for which all named numbers are the same, bit for bit."""
    same = [(one[name] == other[name]).reshape(len(one[name]), -1).all(axis=1) for name in names]
    return int(np.all(same, axis=0).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--hands", nargs="*", default=["allegro", "barrett", "shadow"])
    parser.add_argument("--objects", nargs="*", default=["mug", "bottle"])
    parser.add_argument("--grasps", type=int, default=64)
    parser.add_argument("--level", default="standard")
    given = parser.parse_args()
    lines = [
        "| pair | grasps | same outcomes | all numbers the same | ms before | ms after |",
        "| --- |" + " --: |" * 5,
    ]
    totals = np.zeros(5)
    for hand in given.hands:
        for obj in given.objects:
            (urdf, *_) = sorted((given.data / "hands" / hand).glob("*.urdf"))
            folder = given.data / "objects" / obj
            name = str((folder / "clean.stl").resolve()) if folder.is_dir() else obj
            with tempfile.TemporaryDirectory() as work:
                pair = (str(urdf.resolve()), name, f"{work}/grasps.npz")
                run(given.after.resolve(), PLAN, *pair, str(given.grasps))
                for number, root in enumerate((given.before, given.after)):
                    run(root.resolve(), VALIDATE, *pair, f"{work}/{number}.npz", given.level)
                found = [dict(np.load(f"{work}/{number}.npz")) for number in range(2)]
            exact = ("outcome", "margin", "penetration_depth_mm", "self_penetration_depth_mm")
            count = len(found[0]["outcome"])
            row = [
                count,
                equal_rows(*found, ("outcome",)),
                equal_rows(*found, exact),
                *(1e3 * float(one["spent"]) for one in found),
            ]
            totals += row
            lines.append(line(f"{hand}, {obj}", row))
    sys.stdout.write("\n".join([*lines, line("**all**", list(totals))]) + "\n")


def line(pair: str, row: list[float]) -> str:
    """One line of the table; times are of a grasp."""
    return f"| {pair} | {row[0]:.0f} | {row[1]:.0f} | {row[2]:.0f} | {row[3] / row[0]:.1f} | {row[4] / row[0]:.1f} |"


if __name__ == "__main__":
    main()
