"""What a picture costs in two checkouts, and in how much they differ; prints Markdown.

usage: python -m benchmarks.pictures BEFORE AFTER [--objects mug bottle] [--views 3]

Processor time of one thread, of two scenes in the pilot's size, in one run: of a process's first call, with kernels in
the cache, and the least of three more.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.chain import environment_of

CHILD: Final = """
import json, sys, time
import numpy as np
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.scenes import drop

obj = object_from_path(sys.argv[1], face_error_m=5e-4)
poses = drop(obj, count=2, seed=1)["scene/object_pose"]
spent = []
for _ in range(4):
    began = time.process_time()
    from graspd.worker.rendering import render
    from graspd.worker.execution_context import Run
    made = render(
        obj, poses, views=int(sys.argv[2]), stereo=False, width=320, height=240, seed=0, run=Run(threads=1)
    )
    spent.append(time.process_time() - began)
np.savez(sys.argv[3], **{name.replace("/", "."): values for name, values in made.items()})
print(json.dumps({"first": spent[0], "ms": 1e3 * min(spent[1:]) / len(made["image/rgb"])}))
"""


def run(root: Path, *arguments: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The numbers and the arrays of one checkout; ends the program if it fails."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "made.npz"
        done = subprocess.run(
            [sys.executable, "-c", CHILD, *arguments, str(file)],
            cwd=root,
            env=environment_of(root),
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            sys.exit(f"{root}: {done.stderr[-2000:]}")
        with np.load(file) as stored:
            made = {name: stored[name] for name in stored.files}
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found, made


def differences(before: dict[str, NDArray[Any]], after: dict[str, NDArray[Any]]) -> str:
    """For each array that is not the same: how many values are others, and by how much at most."""
    found = []
    for name in sorted(before):
        one, other = before[name].astype(float), after[name].astype(float)
        differ = ~((one == other) | (np.isnan(one) & np.isnan(other)))
        if differ.any():
            most = np.abs(one[differ] - other[differ]).max()
            found.append(f"{name}: {differ.sum():,} of {one.size:,} by {most:.2g} at most")
    return "; ".join(found) or "none"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--objects", nargs="*", default=["mug", "bottle"])
    parser.add_argument("--views", type=int, default=3)
    given = parser.parse_args()
    sys.stdout.write(
        "| object | core-ms a picture before | after | times | first call, core-s, before | after "
        "| values that differ |\n"
        "| --- | --: | --: | --: | --: | --: | --- |\n"
    )
    for obj in given.objects:
        (one, held), (other, made) = (
            run(root.resolve(), obj, str(given.views)) for root in (given.before, given.after)
        )
        sys.stdout.write(
            f"| {obj} | {one['ms']:.0f} | {other['ms']:.0f} | {one['ms'] / other['ms']:.2f} | {one['first']:.2f} "
            f"| {other['first']:.2f} | {differences(held, made)} |\n"
        )


if __name__ == "__main__":
    main()
