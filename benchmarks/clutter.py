"""Valid grasps of a target among neighbours on a table, per scene, in limited time.

usage: python -m benchmarks.clutter DATA_DIR [--hand allegro] [--targets 025_mug ...] [--scenes 2] [--neighbours 4]
           [--seconds 60] [--json OUT]                            DATA_DIR holds hands/ and objects/

Neighbours are drawn from the other objects and dropped with the target. The time includes planning and validation, but
not kernels, convex pieces and drops. A second stands for two seconds of processor time (two cores), so other load
changes the figures little. The gap is the distance to the nearest neighbour."""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cells import HANDS
from graspd.service.model.domain import BATCH_SIZE, JobOptions
from graspd.service.model.errors import MeshError
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.scene_spec import SceneSpec
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.scenes.placement import gaps_between, neighbour_of, scenes_of

#: Seed that was not used to choose any setting.
SEED = 505
CORES = 2
FIDELITY = FIDELITIES["standard"]
TITLES = ("target", "scene", "neighbours", "gap, mm", "valid", "candidates", "clear", "lift", "seconds")


def study(hand: HandModel, obj: ObjectModel, others: list[ObjectModel], scene: int, seconds: float) -> dict[str, Any]:
    spec = SceneSpec(kind="table", neighbours=tuple({"object": other.name} for other in others))  # type: ignore[arg-type]
    scenes, poses = scenes_of(spec, obj, others, count=scene + 1, seed=SEED)
    things = [neighbour_of(obj), *scenes.neighbours]
    together = np.concatenate([poses["scene/object_pose"][:, None], poses["scene/neighbour_pose"]], axis=1)[-1:]
    gap = min(float(found[0]) for pair, found in gaps_between(things, together, 0.5).items() if pair[0] == 0)
    here = replace(scenes, object_pose=scenes.object_pose[-1:], neighbour_pose=scenes.neighbour_pose[-1:])
    request = JobOptions(grasps=BATCH_SIZE, want="candidates", seed=SEED, fidelity=FIDELITY, rechecks=0)
    found = {"valid": 0, "candidates": 0, "clear": 0.0, "lift": 0.0}
    validated_grasps(hand, obj, request, count=2, batch=1 << 19, scenes=here, run=ExecutionContext())  # kernels, pieces
    began, batch = time.process_time(), 0
    while (spent := (time.process_time() - began) / CORES) < seconds:
        made = validated_grasps(hand, obj, request, count=BATCH_SIZE, batch=batch, scenes=here, run=ExecutionContext())
        if (time.process_time() - began) / CORES > seconds and batch:
            break  # too late to count
        found["valid"] += int(made.columns["quality/valid"].sum())
        found["candidates"] += made.planned
        found["clear"] += made.shares["clear_share"] * made.planned
        found["lift"] += made.shares["lift_share"] * made.planned
        batch += 1
    candidates = max(1, found["candidates"])
    return {
        **found,
        "clear": found["clear"] / candidates,
        "lift": found["lift"] / candidates,
        "gap": 1e3 * gap,
        "seconds": min(spent, seconds),
    }


def crowd(
    hand: HandModel, obj: ObjectModel, meshes: dict[str, Path], scene: int, said: argparse.Namespace
) -> tuple[list[ObjectModel], dict[str, Any]]:
    """Return the neighbours and numbers of a scene; redraw neighbours that do not come to rest apart."""
    rng = np.random.default_rng([SEED, scene])
    while True:
        names = rng.choice(sorted(meshes), said.neighbours, replace=False)
        others = [object_from_path(meshes[name], face_error_m=FIDELITY.face_error_m) for name in names]
        try:
            return others, study(hand, obj, others, scene, said.seconds)
        except MeshError as error:
            sys.stderr.write(f"{error}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--hand", default="allegro", choices=list(HANDS))
    parser.add_argument("--targets", nargs="+", default=["025_mug", "006_mustard_bottle", "077_rubiks_cube"])
    parser.add_argument("--scenes", type=int, default=2)
    parser.add_argument("--neighbours", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--json", type=Path)
    said = parser.parse_args()
    hand = hand_from_path(said.data / "hands" / HANDS[said.hand])
    meshes = {path.parent.name: path for path in sorted((said.data / "objects").glob("*/clean.stl"))}
    rows = []
    sys.stdout.write("| " + " | ".join(TITLES) + " |\n| --- |" + " --: |" * (len(TITLES) - 1) + "\n")
    for target in said.targets:
        obj = object_from_path(meshes[target], face_error_m=FIDELITY.face_error_m)
        for scene in range(said.scenes):
            others, row = crowd(hand, obj, {n: p for n, p in meshes.items() if n != target}, scene, said)
            row = {"target": target, "scene": scene, **row}
            rows.append(row)
            sys.stdout.write(
                f"| {target} | {scene} | {len(others)} | {row['gap']:.0f} | {row['valid']} | {row['candidates']} | "
                f"{row['clear']:.2f} | {row['lift']:.2f} | {row['seconds']:.0f} |\n"
            )
            sys.stdout.flush()
    if said.json:
        said.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
