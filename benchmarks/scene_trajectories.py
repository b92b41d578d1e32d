"""Obstructed grasps in bins, on shelves and among neighbours, by phase of the trajectory.

    python -m benchmarks.scene_trajectories [--count 24] [--json]

Prints Markdown. The approach is a straight line of 10 cm. The last column counts grasps that are obstructed only on
the approach. A curved approach could save at most these."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any, Final

import numpy as np

from graspd.service.model.fidelity import resolve_fidelity
from graspd.service.model.scene_spec import SceneSpec
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.scenes.clearance import MARGIN_M
from graspd.worker.scenes.placement import scenes_of
from graspd.worker.scenes.trajectory import Trajectory, plan_trajectory

HANDS: Final = ("barrett", "allegro", "shadow")
#: Target, kind of its scene, and its neighbours.
PLACES: Final = (
    ("block", "bin", ("mug", "bottle", "block")),
    ("bottle", "bin", ("block", "mug")),
    ("mug", "shelf", ("block", "bottle")),
    ("bottle", "shelf", ()),
    ("mug", "table", ("block",) * 6),
)
SCENES: Final = 4
SEEDS: Final = (11, 3)  # of the scenes, of the grasps
COUNTS: Final = ("grasps", "clear", "contact", "closing", "lift", "coming")
COLUMNS: Final = ("hand", "object", "scene", "beside", *COUNTS)
HEADS: Final = ("hand", "object", "scene", "neighbours", *COUNTS[:-1], "approach")
ABOUT: Final = """\
Candidates of the built-in hands at fidelity `draft`. *Clear*: at least 2 mm from all obstacles on the whole
trajectory. Other grasps are too close to an obstacle at contact, while closing, on the lift, or only on the straight
approach of 10 cm. A curved approach could save at most the last group."""


def blocked(way: Trajectory) -> dict[str, int]:
    """Return the numbers of clear grasps, and of grasps blocked in each phase of the trajectory."""
    parts = {"contact": way.contact, "closing": way.closing, "lift": way.lifting}
    near = {name: distance < MARGIN_M for name, distance in parts.items()}
    elsewhere = np.any(list(near.values()), axis=0)
    return {
        "clear": int(way.clear.sum()),
        **{name: int(found.sum()) for name, found in near.items()},
        "coming": int((~way.clear & ~elsewhere).sum()),
    }


def run(count: int) -> list[dict[str, Any]]:
    """Return a row for each hand and scene, with `count` draft candidates each."""
    fidelity = resolve_fidelity("draft")
    names = {name for target, _, beside in PLACES for name in (target, *beside)}
    things = {name: object_from_path(name, face_error_m=fidelity.face_error_m) for name in names}
    rows = []
    for name in HANDS:
        hand = hand_from_path(name)
        for target, kind, beside in PLACES:
            spec = SceneSpec(kind=kind, neighbours=tuple({"object": one} for one in beside), touch=2.0)
            scenes, _ = scenes_of(spec, things[target], [things[one] for one in beside], count=SCENES, seed=SEEDS[0])
            placed = scenes.placed(np.arange(count) % SCENES)
            wanted = PlanRequest(count=count, fidelity=fidelity, seed=SEEDS[1], placed=placed)
            way = plan_trajectory(hand, things[target], synthesize(hand, things[target], wanted), placed)
            told = {"hand": name, "object": target, "scene": kind, "beside": len(beside), "grasps": count}
            rows.append(told | blocked(way))
            sys.stderr.write(f"{name}: {target}, {kind}\n")
    return rows


def page(rows: list[dict[str, Any]], total: dict[str, int]) -> str:
    lines = [HEADS, ["---"] * 3 + ["--:"] * (len(COLUMNS) - 3)]
    lines += [[str(row[name]) for name in COLUMNS] for row in rows]
    lines += [["**all**", "", "", "", *(f"**{count}**" for count in total.values())]]
    return ABOUT + "\n\n" + "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=24, help="candidates for each hand and scene")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    rows = run(given.count)
    total = {key: sum(row[key] for row in rows) for key in COUNTS}
    sys.stdout.write((json.dumps({"rows": rows, "total": total}) if given.json else page(rows, total)) + "\n")


if __name__ == "__main__":
    main()
