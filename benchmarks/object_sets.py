"""Share of the objects of a folder that are accepted, refusals by reason, and CPU time per object.

    python -m benchmarks.object_sets FOLDER --count 100

A folder holds meshes, or URDF, SDF and MJCF files with their meshes, as `graspd objects check` takes it."""

from __future__ import annotations

import argparse
import random
import re
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

from graspd.service.store.object_sets import group_objects, read_set
from graspd.worker.objects.check import check_object


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=0, help="number of objects, drawn at random; 0: all")
    parser.add_argument("--seed", type=int, default=0)
    wanted = parser.parse_args()
    objects = group_objects(read_set(wanted.folder, limit_bytes=2**33))
    names = list(objects)
    if 0 < wanted.count < len(names):
        names = sorted(random.Random(wanted.seed).sample(names, wanted.count))
    seconds, refusals, repairs, accepted = list[float](), list[tuple[str, str]](), Counter[str](), 0
    for name in names:
        start = time.process_time()
        report = check_object(objects[name], name)
        seconds.append(time.process_time() - start)
        if report["verdict"] == "refuse":
            refusals.append((name, report["message"]))
            continue
        accepted += 1
        repairs.update({_kind(text) for text in (*report["repairs"], *report["facts"]["notes"])})
    half, most = np.quantile(seconds, [0.5, 0.99])
    lines = [
        f"{accepted} of {len(names)} objects accepted, {len(refusals)} refused",
        f"CPU time per object: p50 {half:.2f} s, p99 {most:.2f} s, largest {max(seconds):.2f} s",
        *(f"  {count:4d} accepted: {kind}" for kind, count in repairs.most_common()),
    ]
    reasons = Counter(_kind(message.partition(": ")[2]) for _, message in refusals)
    for kind, count in reasons.most_common():
        first = next(name for name, message in refusals if _kind(message.partition(": ")[2]) == kind)
        lines.append(f"  {count:4d} refused: {kind} (first: {first})")
    sys.stdout.write("\n".join(lines) + "\n")


def _kind(text: str) -> str:
    """Return a message with its numbers replaced, so that equal reasons count together."""
    return re.sub(r"\d[\d.e+-]*", "N", text)


if __name__ == "__main__":
    main()
