"""Comparison of grasps planned in scenes with filtered free grasps, per hand and object.

usage: python -m benchmarks.scene_grasps DATA_DIR [--work W] [--hands allegro ...] [--objects 025_mug ...] [--grasps 32]
           [--per-face 0] [--filtered 0] [--touch 0] [--seed 404] [--json OUT] [--page OUT.md]
       DATA_DIR holds hands/ and objects/

Scenes: the object on a table, on each stable resting face that at least 3 % of drops reach. Each pair has at least
`--grasps` grasps and at least `--per-face` per face. Free grasps are placed into the same scenes and validated alike;
each pair has at least `--filtered` of them, because few lift. Seconds are CPU time of one thread, so other load changes
the ratios little. W caches the results of each pair: an interrupted run resumes, and runs with different hands may run
at the same time."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cells import HANDS, cell_parser
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.scene_spec import TOUCH, SceneSpec
from graspd.service.model.version import PACKAGE_VERSION
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import pinch_postures_of
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import ExecutionContext, PlanRequest, synthesize
from graspd.worker.planners.fast_graspd.antipodal_starts import Openings
from graspd.worker.scenes.clearance import MARGIN_M
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.scenes.rollout import create_rollout
from graspd.worker.scenes.trajectory import plan_trajectory
from graspd.worker.simulation.environment import PlacedGrasps, Scenes
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.lifting import validate_lifts
from graspd.worker.validation.validator import validate

COMMAND = (
    "python -m benchmarks.scene_grasps DATA --work W --grasps 16 --per-face 2 --filtered 96 "
    "--page docs/results/scenes-grasps.md --json docs/results/scenes-grasps.json"
)
#: Seed that was not used to choose any setting.
SEED = 404
FIDELITY = FIDELITIES["standard"]
TITLES = {
    "object": "object",
    "count": "grasps",
    "faces": "faces",
    "clear_contact": "clear at contact",
    "clear_way": "clear trajectory",
    "pushes_of_clear": "held in six pushes, of clear",
    "dexgraspbench": "dexgraspbench, clear",
    "lift": "lift",
    "hard": "lift, half friction",
    "faces_held": "faces with a lift",
    "reach": "faces in reach",
    "reach_held": "with a lift, of faces in reach",
    "filter_lift": "free, filtered: lift",
    "price": "CPU time / free",
    "gain": "valid/s / filtered",
    "of_free": "valid/s / free",
}


def study(
    hand: HandModel,
    obj: ObjectModel,
    pieces: ConvexPieces,
    least: int,
    per_face: int,
    *,
    filtered: int = 0,
    touch: float = TOUCH,
    seed: int = SEED,
) -> dict[str, Any]:
    """Return the numbers of one pair; shares are of all candidates."""
    spec = SceneSpec(kind="table", faces="all", touch=touch)
    poses = rest_poses(spec, obj, count=1, seed=seed)["scene/object_pose"]
    count = max(least, per_face * len(poses))
    placed = Scenes(supports_of(spec), poses).placed(np.arange(count) % len(poses))
    wanted, run = PlanRequest(count, FIDELITY, seed), ExecutionContext(threads=1)
    lifts, pushes = (create_rollout(run, hand, obj, lambda: pieces, in_scenes=where) for where in (True, False))
    # Untimed preparation, which every pair needs once.
    for where, rollout in ((placed.take(slice(0, 1)), lifts), (None, pushes)):
        synthesize(hand, obj, PlanRequest(1, FIDELITY, SEED, placed=where, rollout=rollout), run)
    planned, seconds = _timed(lambda: synthesize(hand, obj, replace(wanted, placed=placed, rollout=lifts), run))
    many = max(count, filtered)
    free, free_seconds = _timed(lambda: synthesize(hand, obj, replace(wanted, count=many, rollout=pushes), run))
    free_seconds *= count / many
    found = _validated(hand, obj, planned, placed, pieces)
    scenes = Scenes(supports_of(spec), poses).placed(np.arange(many) % len(poses))
    free_lift = _validated(hand, obj, free, scenes, pieces, only_lift=True)["lift"]
    free_held = validate(hand, obj, free.take(np.arange(count)), pieces=pieces).success.mean()
    rate, free_rate = found["lift"] / seconds, free_lift / free_seconds
    held = np.asarray(found.pop("rows"))
    faces = np.array([held[placed.index == s].any() for s in range(len(poses))])
    known = pinch_postures_of(hand)
    reach = np.array([Openings.of(known, obj, scene).within_reach for scene in placed.scenes])
    return {
        **found,
        "count": count,
        "faces": len(poses),
        "faces_held": float(faces.mean()),
        "reach": int(reach.sum()),
        "reach_held": float(faces[reach].mean()) if reach.any() else None,
        "pushes_of_clear": found["pushes"] / found["clear_way"] if found["clear_way"] else None,
        "filter_count": many,
        "filter_lift": free_lift,
        "seconds": seconds / count,
        "free_seconds": free_seconds / count,
        "price": seconds / free_seconds,
        "gain": rate / free_rate if free_rate else rate * many * free_seconds,
        "gain_at_least": not free_rate,
        "of_free": rate / (free_held / free_seconds) if free_held else None,
    }


def _validated(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    placed: PlacedGrasps,
    pieces: ConvexPieces,
    *,
    only_lift: bool = False,
) -> dict[str, Any]:
    way = plan_trajectory(hand, obj, grasps, placed)
    grasps = replace(grasps, approach=way.approach, coming=way.open, lift=way.lift)
    clear = np.flatnonzero(way.clear)
    share = {"clear_contact": float((way.contact >= MARGIN_M).mean()), "clear_way": float(way.clear.mean())}
    mine, where = grasps.take(clear), placed.take(clear)
    lifted = np.zeros(len(grasps), bool)
    levels: dict[str, dict[str, Any]] = {
        "lift": {},
        "hard": {"hard": True},
        "dexgraspbench": {"level": "dexgraspbench"},
    }
    for name, options in list(levels.items())[: 1 if only_lift else None]:
        verdicts = validate_lifts(hand, obj, mine, where, pieces=pieces, **options)
        share[name] = float(verdicts.success.sum() / len(grasps))
        if name == "lift":
            lifted[clear[verdicts.success == 1]] = True
    if only_lift:
        return share
    pushes = validate(hand, obj, mine, pieces=pieces).success.sum() if len(clear) else 0
    return {**share, "pushes": float(pushes / len(grasps)), "rows": lifted.tolist()}


def _timed(work: Any) -> tuple[Any, float]:
    began = time.thread_time()
    done = work()
    return done, time.thread_time() - began


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def table(rows: list[dict[str, Any]]) -> str:
    """Return the pairs of one hand as Markdown, then their means (of ratios: medians)."""
    counts = ("count", "faces", "reach")
    whole: dict[str, Any] = {"object": "mean; ratios: median", **{n: sum(row[n] for row in rows) for n in counts}}
    for name in [name for name in TITLES if name not in ("object", *counts)]:
        known = [row[name] for row in rows if row[name] is not None]
        middle = np.median if name in ("price", "gain", "of_free") else np.mean
        whole[name] = float(middle(known)) if known else None
    lines = ["| " + " | ".join(TITLES.values()) + " |", "| --- |" + " --: |" * (len(TITLES) - 1)]
    for row in [*rows, whole]:
        cells = {name: _cell(row[name]) for name in TITLES}
        if row.get("gain_at_least") and row["gain"]:
            cells["gain"] = "> " + cells["gain"]
        lines.append("| " + " | ".join(cells.values()) + " |")
    return "\n".join(lines)


def page(results: dict[str, list[dict[str, Any]]]) -> str:
    """Return the tables of all hands as a page of the docs."""
    lines = [
        "# Grasps planned in scenes",
        "",
        f"graspd {PACKAGE_VERSION}, `{COMMAND}`: real URDFs, fidelity *{FIDELITY.name}*, seed {SEED}. Scenes: the "
        "object on a table, on each stable resting face that at least 3 % of drops reach.",
        "",
        "- Shares are of all candidates unless stated otherwise; seconds are CPU time of planning.",
        "- *Faces in reach*: faces with an antipodal pair of points at least 4 mm above the table and tilted by less",
        "  than 30 degrees. The pair must fit into the opening of the fingers.",
        "- *Free, filtered*: grasps of a free object, placed into the same scenes.",
        "- *CPU time / free*: CPU time per grasp, relative to free grasps.",
        "- *valid/s / filtered*, *valid/s / free*: valid grasps per second, relative to filtered and to free grasps.",
        "  *>*: no filtered grasp lifts; the ratio is a lower bound, computed with one lifted grasp.",
    ]
    for name, rows in results.items():
        lines += ["", f"## {name}", "", table(rows)]
    every = [row for rows in results.values() for row in rows]
    raw = sum(row["count"] for row in every)
    lifted, filtered = (
        round(sum(row[name] * row[count] for row in every))
        for name, count in (("lift", "count"), ("filter_lift", "filter_count"))
    )
    seconds = sum(row["seconds"] * row["count"] for row in every)
    free_seconds = sum(row["free_seconds"] * row["filter_count"] for row in every)
    lines += [
        "",
        f"Of grasps planned in their scenes, {lifted} of {raw} lift, {lifted / seconds:.2f} per second. Of filtered "
        f"free grasps, {filtered} of {sum(row['filter_count'] for row in every)} lift, {filtered / free_seconds:.3f} "
        "per "
        f"second. The ratio of these rates is {lifted / seconds * free_seconds / max(filtered, 1):.0f}.",
    ]
    return "\n".join(
        [*lines, "", "## All pairs", "", *table(every).splitlines()[:2], table(every).splitlines()[-1], ""]
    )


def main() -> None:
    parser = cell_parser(__doc__, grasps=32)
    parser.add_argument("--per-face", type=int, default=0)
    parser.add_argument("--filtered", type=int, default=0, help="least number of filtered free grasps per pair")
    parser.add_argument("--touch", type=float, default=TOUCH, help="least distance of fingertips from the table [mm]")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--page", type=Path)
    said = parser.parse_args()
    results: dict[str, list[dict[str, Any]]] = {}
    for name in said.hands:
        hand = hand_from_path(said.data / "hands" / HANDS[name])
        rows = results.setdefault(name, [])
        for mesh in sorted((said.data / "objects").glob("*/clean.stl")):
            if said.objects and mesh.parent.name not in said.objects:
                continue
            terms = f"{said.grasps}-{said.per_face}-{said.filtered}-{said.touch:g}-{said.seed}"
            kept = said.work / "scene-grasps" / f"{name}-{mesh.parent.name}-{terms}.json"
            if not kept.exists():
                obj = object_from_path(mesh, face_error_m=FIDELITY.face_error_m)
                found = study(
                    hand,
                    obj,
                    decompose(obj, cache=said.work / "pieces"),
                    said.grasps,
                    said.per_face,
                    filtered=said.filtered,
                    touch=said.touch,
                    seed=said.seed,
                )
                kept.parent.mkdir(parents=True, exist_ok=True)
                kept.write_text(json.dumps(found))
            rows.append({"object": mesh.parent.name, **json.loads(kept.read_text())})
            sys.stderr.write(f"{name} {mesh.parent.name}: lift {rows[-1]['lift']:.2f}\n")
        sys.stdout.write(f"\n{name}\n\n{table(rows)}\n")
        sys.stdout.flush()
    if said.page:
        said.page.write_text(page(results))
    if said.json:
        said.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
