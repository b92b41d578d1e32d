"""Success of grippers on objects that fit and that were not used for tuning.

    python -m benchmarks.grippers DATA --sources /tmp/hands

DATA holds objects/ (YCB and others); the sources are those of `benchmarks.gallery`. Results are cached in
`docs/results/grippers.json` by the gripper's digest and the planner's revision, so an interrupted run resumes. `--out
FOLDER` replaces docs/results/."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gallery import HANDS
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.version import STAGE_REVISIONS
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.prepare import object_from_path

GRIPPERS = ("franka", "robotiq-2f-85", "schunk-egk40", "umi", "robotiq-2f-140", "rethink", "robotiq-3f")
#: Seed that was not used to choose any setting.
SEED = 404


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--sources", type=Path, required=True)
    parser.add_argument("--grasps", type=int, default=12)
    parser.add_argument("--only", help="names of grippers, comma-separated")
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    results = asked.out / "grippers.json"
    done: dict[str, Any] = json.loads(results.read_text()) if results.is_file() else {}
    entries = {entry.name: entry for entry in HANDS}
    objects = sorted(asked.data.glob("objects/*/clean.stl"))
    for name in asked.only.split(",") if asked.only else GRIPPERS:
        entry = entries[name]
        hand = hand_from_path(asked.sources / entry.path, entry.options)
        key = f"{hand.content[:16]}-{asked.grasps}-{SEED}-{STAGE_REVISIONS['synthesize']}"
        if done.get(name, {}).get("key") != key:
            jaws = jaws_of(hand)
            done[name] = {
                "key": key,
                "title": entry.title,
                "grasps": asked.grasps,
                "cells": {},
                "opening_mm": round(1e3 * jaws.opening, 1) if jaws else None,
            }
        for mesh in objects:
            cells = done[name]["cells"]
            if mesh.parent.name not in cells:
                cells[mesh.parent.name] = cell(hand, mesh, asked.grasps)
                sys.stderr.write(f"{name} {mesh.parent.name} {cells[mesh.parent.name]}\n")
                results.write_text(json.dumps(done, indent=1) + "\n")
    (asked.out / "grippers.md").write_text(page(done))


def cell(hand: HandModel, mesh: Path, grasps: int) -> float | str:
    """Return the share of candidates that hold at level standard, or the reason for a refusal."""
    obj = object_from_path(str(mesh), face_error_m=3e-4)
    request = JobOptions(want="candidates", grasps=grasps, seed=SEED, validation="standard")
    try:
        found = validated_grasps(hand, obj, request, count=grasps)
    except InputError as error:
        return str(error)
    return float(np.mean(found.columns["quality/success"] == 1))


def page(done: dict[str, Any]) -> str:
    names = [name for name in GRIPPERS if name in done]
    objects = sorted({obj for name in names for obj in done[name]["cells"]})
    means = []
    for name in names:
        held = [value for value in done[name]["cells"].values() if not isinstance(value, str)]
        means.append(f"**{np.mean(held):.2f}** of {len(held)}")
    titles = [
        f"{done[n]['title']}" + (f", {done[n]['opening_mm']:.0f} mm" if done[n]["opening_mm"] else "") for n in names
    ]
    rows = [
        "# Grippers on objects that fit",
        "",
        "`python -m benchmarks.grippers DATA --sources /tmp/hands`: share of candidates that hold at level *standard*; "
        f"{done[names[0]]['grasps']} candidates per cell, fidelity *standard*, seed {SEED}. No setting was tuned on "
        "these "
        "objects. Column titles have the opening of each gripper. *Too wide*: the gripper does not open far enough; "
        "*none*: refused for another reason. The mean is over objects that fit.",
        "",
        "| object | " + " | ".join(titles) + " |",
        "| --- |" + " --: |" * len(names),
    ]
    for obj in objects:
        cells = (done[name]["cells"].get(obj) for name in names)
        shown = [
            "" if c is None else ("too wide" if "opens" in c else "none") if isinstance(c, str) else f"{c:.2f}"
            for c in cells
        ]
        rows.append(f"| {obj} | " + " | ".join(shown) + " |")
    rows.append("| mean | " + " | ".join(means) + " |")
    return "\n".join(rows) + "\n"


if __name__ == "__main__":
    main()
