"""What a picture costs in two checkouts, and whether it is the same; prints Markdown.

usage: python -m benchmarks.pictures BEFORE AFTER [--objects mug bottle] [--views 3]

Processor time of one thread, after a render that is not timed, of two scenes in the pilot's size, in one run.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

from benchmarks.chain import environment_of

CHILD: Final = """
import hashlib, json, sys, time
import numpy as np
from worker.objects.prepare import object_from_path
from worker.rendering import render
from worker.run import Run
from worker.scenes import drop

obj = object_from_path(sys.argv[1], face_error_m=5e-4)
poses = drop(obj, count=2, seed=1)["scene/object_pose"]
options = dict(views=int(sys.argv[2]), stereo=False, width=320, height=240, seed=0, run=Run(threads=1))
render(obj, poses, **options)
spent = []
for _ in range(3):
    began = time.process_time()
    made = render(obj, poses, **options)
    spent.append(time.process_time() - began)
whole = hashlib.sha256()
for name in sorted(made):
    whole.update(np.ascontiguousarray(made[name]).tobytes())
count = len(made["image/rgb"])
print(json.dumps({"ms": 1e3 * min(spent) / count, "digest": whole.hexdigest()}))
"""


def run(root: Path, *arguments: str) -> dict[str, Any]:
    """The numbers of one checkout; ends the program if it fails."""
    done = subprocess.run(
        [sys.executable, "-c", CHILD, *arguments], cwd=root, env=environment_of(root), capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    if done.returncode:
        sys.exit(f"{root}: {done.stderr[-2000:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--objects", nargs="*", default=["mug", "bottle"])
    parser.add_argument("--views", type=int, default=3)
    given = parser.parse_args()
    sys.stdout.write("| object | core-ms a picture before | after | times | every value the same |\n")
    sys.stdout.write("| --- | --: | --: | --: | --- |\n")
    for obj in given.objects:
        one, other = (run(root.resolve(), obj, str(given.views)) for root in (given.before, given.after))
        same = "yes" if one["digest"] == other["digest"] else "no"
        sys.stdout.write(f"| {obj} | {one['ms']:.0f} | {other['ms']:.0f} | {one['ms'] / other['ms']:.2f} | {same} |\n")


if __name__ == "__main__":
    main()
