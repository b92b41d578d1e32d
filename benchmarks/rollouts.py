"""Effect of rollouts: candidates around free objects selected by merit alone, and by rollouts.

usage: python -m benchmarks.rollouts DATA --work WORK --out FOLDER [--hands ...] [--objects ...] [--grasps 8]

Both selections of a pair are measured in one run. Times are processor time of one thread for planning, postures and, if
used, rollouts. DATA holds hands/ and objects/. Pairs with results in WORK are not repeated."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.cells import HANDS, cell_parser, kept_json, write_json
from graspd.service.model.fidelity import FIDELITIES
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.quality.table import measure
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.prescreening import ShortTests
from graspd.worker.validation.validator import validate

#: Seeds that were not used to choose any setting.
SEED, WARM_SEED = 2027, 1
FIDELITY = FIDELITIES["standard"]
WAYS: Final = {"merit": "by merit", "rollout": "by rollout"}
#: Friction and contact threshold of ε as in table 2 of the paper.
FRICTION, THRESHOLD_M = 1.0, 0.005
ONE = ExecutionContext(threads=1)


def found_of(hand: HandModel, mesh: Path, count: int) -> dict[str, dict[str, Any]]:
    """Return, for each of `WAYS`, counts and seconds of all grasps."""
    obj = object_from_path(mesh, face_error_m=FIDELITY.face_error_m)
    pieces = decompose(obj)
    rollouts = {"merit": None, "rollout": ShortTests(hand, obj, lambda: pieces).scores}
    found: dict[str, dict[str, Any]] = {}
    for way, rollout in rollouts.items():
        synthesize(hand, obj, PlanRequest(1, FIDELITY, WARM_SEED, rollout=rollout), ONE)
        began = time.process_time()
        grasps = synthesize(hand, obj, PlanRequest(count, FIDELITY, SEED, rollout=rollout), ONE)
        planned, began = time.process_time() - began, time.process_time()
        held = validate(hand, obj, grasps, pieces=pieces, run=ONE).success
        validated = time.process_time() - began
        hard = validate(hand, obj, grasps, pieces=pieces, hard=True, run=ONE).success
        table = measure(hand, obj, grasps, friction=FRICTION, thresholds_m=[THRESHOLD_M])
        best = np.argsort(-table["quality/epsilon"][:, 0])[: max(1, count // 3)]
        found[way] = {
            "grasps": count,
            "held": int(held.sum()),
            "hard": int((held & hard).sum()),
            "planned_s": planned,
            "validated_s": validated,
            "depth_mm": float(np.median(table["quality/penetration_depth_mm"])),
            "area_cm2": float(table["quality/contact_area_cm2"][best].mean()),
            "epsilon": float(table["quality/epsilon"][best].mean()),
        }
    return found


def row(hand: str, way: str, pairs: list[dict[str, Any]]) -> str:
    grasps, held, hard = (sum(found[key] for found in pairs) for key in ("grasps", "held", "hard"))
    planned, validated = (1e3 * sum(found[key] for found in pairs) for key in ("planned_s", "validated_s"))
    worst = min(found["held"] / found["grasps"] for found in pairs)
    cells = [hand, WAYS[way], f"{held / grasps:.2f}", f"{worst:.2f}", f"{hard / grasps:.2f}"]
    cells += [f"{ms / grasps:.0f}" for ms in (planned, validated)]
    cells += [f"{(planned + validated) / max(1, count):.0f}" for count in (held, hard)]
    cells += [f"{np.median([found['depth_mm'] for found in pairs]):.2f}"]
    cells += [f"{np.mean([found['area_cm2'] for found in pairs]):.0f}"]
    cells += [f"{np.mean([found['epsilon'] for found in pairs]):.2f}"]
    return f"| {' | '.join(cells)} |"


def page(done: dict[str, dict[str, dict[str, Any]]], count: int) -> str:
    titles = (
        "hand",
        "selection",
        "GSR",
        "GSR of worst object",
        "hard",
        "planner ms",
        "validator ms",
        "ms per held",
        "ms per hard",
        "PD mm",
        "CA cm²",
        "ε",
    )
    objects = len(next(iter(done.values())))
    return "\n".join(
        [
            "# Candidates selected by rollouts",
            "",
            f"`python -m benchmarks.rollouts DATA --out docs/results`: {count} candidates of each hand on each "
            f"of {objects} objects without a scene, seed {SEED}, validated at level *standard*. One run measures "
            "both selections.",
            "",
            "- *By merit*: selects the candidate with the best contact balance; *by rollout*: the first that holds "
            "in a "
            "short test.",
            "- *GSR*: share that holds; *hard*: share that also holds at half friction.",
            "- *Planner*, *validator*: core-ms per candidate; the next two columns: core-ms of both per held "
            "candidate, "
            "and per",
            "  candidate that also holds at half friction.",
            "- *PD*: penetration, median over the objects' medians; *CA* and *ε*: means over the best third of "
            "candidates by ε.",
            "",
            f"| {' | '.join(titles)} |",
            f"| --- | --- |{' --: |' * (len(titles) - 2)}",
            *(row(hand, way, [found[way] for found in pairs.values()]) for hand, pairs in done.items() for way in WAYS),
            "",
        ]
    )


def main() -> None:
    parser = cell_parser(__doc__, grasps=8)
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    names = asked.objects or sorted(path.parent.name for path in (asked.data / "objects").glob("*/clean.stl"))
    kept = asked.work / f"tried-{SEED}-{asked.grasps}"
    done: dict[str, dict[str, dict[str, Any]]] = {}
    for hand_name in asked.hands:
        hand = hand_from_path(asked.data / "hands" / HANDS[hand_name])
        done[hand_name] = {}
        for name in names:
            mesh = asked.data / "objects" / name / "clean.stl"
            make = partial(found_of, hand, mesh, asked.grasps)
            done[hand_name][name] = kept_json(kept / f"{hand_name}-{name}.json", make)
    write_json(asked.out / "tried.json", done)
    (asked.out / "tried.md").write_text(page(done, asked.grasps))


if __name__ == "__main__":
    main()
