"""Quality of candidates of three hands on all objects, under the unmodified DexGraspBench protocol.

usage: python -m benchmarks.results_tables DATA_DIR [--work DIR] [--hands allegro ...] [--objects NAME ...] [--out DIR]
DATA_DIR holds hands/ and objects/. Fidelity is standard. Writes quality-HAND.json and quality-HAND.md to `--out`. An
interrupted run resumes: `--work` caches every pair of hand and object (see cells.py). A run takes some core-hours."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cells import SEED, Cell, cell_parser, cells, write_json
from graspd.service.model.metrics import ROBUST_MODELS
from graspd.service.model.version import PACKAGE_VERSION
from graspd.studies.evaluation import COLUMNS
from graspd.worker.quality.contact import contact_distance_consistency_mm
from graspd.worker.quality.diversity import explained_variance
from graspd.worker.quality.probe import HAND_POINTS, OBJECT_POINTS, probe_of
from graspd.worker.quality.table import measure
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.displacement import simulated_displacement_cm
from graspd.worker.validation.robust import reaches_share, validate_robustness

FRICTION, THRESHOLD_M, TOP, CORES = 1.0, 0.005, 10, 2
#: Share of perturbed models that a robust grasp must hold in.
SHARE = 0.75
#: Fast-Grasp'D, table 2 (YCB): means over the top 10 by epsilon of each object.
PAPER = {
    "barrett": {"ca_cm2": 55.7, "iv_cm3": 4.70, "epsilon": 0.23, "wrench_volume": 5.09, "sd_cm": 1.40},
    "allegro": {"ca_cm2": 49.2, "iv_cm3": 5.62, "epsilon": 0.18, "wrench_volume": 3.42, "sd_cm": 1.66},
    "shadow": {"ca_cm2": 58.6, "iv_cm3": 6.34, "epsilon": 0.18, "wrench_volume": 3.42, "sd_cm": 2.42},
}
#: Columns of the printed table: key, heading, digits.
PRINTED = (
    ("gsr", "GSR", 2),
    ("gsr_hard", "hard", 2),
    ("robust", "robust", 2),
    ("sgs", "SGS", 1),
    ("pd_mm", "PD", 2),
    ("spd_mm", "SPD", 2),
    ("cdc_mm", "CDC", 2),
    ("ca_cm2", "CA", 1),
    ("iv_cm3", "IV", 2),
    ("epsilon", "ε", 2),
    ("wrench_volume", "Vol", 2),
    ("sd_cm", "SD", 2),
    ("diversity", "D", 2),
)


def metrics(cell: Cell) -> dict[str, Any]:
    grasps = cell.grasps
    table = measure(cell.hand, cell.obj, grasps, friction=FRICTION, thresholds_m=[THRESHOLD_M])
    found: dict[str, Any] = {key: np.ravel(table[f"quality/{name}"]).tolist() for key, name in COLUMNS.items()}
    probe = probe_of(cell.hand, cell.obj, hand_points=HAND_POINTS, object_points=OBJECT_POINTS)
    near = probe.body_distance(probe.measure(grasps.grasp))
    found["cdc_mm"] = contact_distance_consistency_mm(cell.hand, near).tolist()
    pieces = decompose(cell.obj)
    found["sd_cm"] = simulated_displacement_cm(cell.hand, cell.obj, grasps.grasp, pieces=pieces).tolist()
    found["diversity"] = float(explained_variance(grasps.grasp)[0])
    return found


def in_models(cell: Cell) -> dict[str, Any]:
    """Return, for each grasp held at level standard, the share of perturbed models in which it holds."""
    held = np.array(cell.verdicts("standard", False)["success"])
    found = validate_robustness(
        cell.hand, cell.obj, cell.grasps, held=held, models=ROBUST_MODELS, seed=SEED, pieces=decompose(cell.obj)
    )
    return {"models": ROBUST_MODELS, "shares": found.share[held == 1].tolist(), "seconds": found.seconds}


def row(cell: Cell) -> dict[str, Any]:
    dexgraspbench, hard = (np.array(cell.verdicts("dexgraspbench", h)["success"]) == 1 for h in (False, True))
    standard = cell.verdicts("standard", False)
    quality = cell.kept("metrics", lambda: metrics(cell))
    shares = np.array(cell.kept(f"models-{ROBUST_MODELS}", lambda: in_models(cell))["shares"])
    top = np.argsort(-np.array(quality["epsilon"]))[:TOP]
    made, validated = cell.cpu_seconds / CORES, standard["cpu_seconds"] / CORES
    return {
        "object": cell.object_name,
        "n": len(dexgraspbench),
        "gsr": float(dexgraspbench.mean()),
        "gsr_hard": float(hard.mean()),
        "robust": float(shares.mean()) if len(shares) else None,
        "robust_n": len(shares),
        "robust_many": int(reaches_share(shares, SHARE).sum()),
        "osr": float(dexgraspbench.any()),
        "osr_hard": float(hard.any()),
        "held": int(dexgraspbench.sum()),
        "seconds": made,
        "validation_seconds": validated,
        "sgs": float(dexgraspbench.sum() / (made + validated)),
        "sgs_without_validation": float(dexgraspbench.sum() / made),
        **{key: float(np.median(quality[key])) for key in (*COLUMNS, "cdc_mm", "sd_cm")},
        "diversity": quality["diversity"],
        "top": {key: float(np.array(quality[key])[top].mean()) for key in PAPER["allegro"]},
        "top_held": float(dexgraspbench[top].mean()),
        **{key: cell.verdicts("dexgraspbench", False)[key] for key in ("pieces", "volume_ratio", "excess_mm", "terms")},
    }


def whole(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return one row over all objects: rates over all grasps, means of the objects' medians."""
    n, held = sum(r["n"] for r in rows), sum(r["held"] for r in rows)
    made, validated = sum(r["seconds"] for r in rows), sum(r["validation_seconds"] for r in rows)
    out = {key: float(np.mean([r[key] for r in rows])) for key, _, _ in PRINTED if key != "robust"}
    validated_batch = sum(r["robust_n"] for r in rows)
    known = [r for r in rows if r["robust_n"]]
    return out | {
        "object": "all",
        "n": n,
        "gsr": held / n,
        "gsr_hard": sum(r["gsr_hard"] * r["n"] for r in rows) / n,
        "robust": sum(r["robust"] * r["robust_n"] for r in known) / validated_batch if validated_batch else None,
        "robust_n": validated_batch,
        "robust_many": sum(r["robust_many"] for r in rows),
        "osr": float(np.mean([r["osr"] for r in rows])),
        "osr_hard": float(np.mean([r["osr_hard"] for r in rows])),
        "sgs": held / (made + validated),
        "sgs_without_validation": held / made,
        "top": {key: float(np.mean([r["top"][key] for r in rows])) for key in PAPER["allegro"]},
        "top_held": float(np.mean([r["top_held"] for r in rows])),
    }


def shown(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def markdown(hand: str, rows: list[dict[str, Any]], total: dict[str, Any], command: str) -> str:
    head = f"| object | {' | '.join(heading for _, heading, _ in PRINTED)} |"
    body = [
        f"| {bold}{r['object']}{bold} | "
        + " | ".join(f"{bold}{shown(r[key], d)}{bold}" for key, _, d in PRINTED)
        + " |"
        for r, bold in [*((r, "") for r in rows), (total, "**")]
    ]
    paper, ours = PAPER[hand], total["top"]
    names = {"ca_cm2": "CA cm²", "epsilon": "ε", "wrench_volume": "Vol", "iv_cm3": "IV cm³", "sd_cm": "SD cm"}
    versus = [f"| {label} | {ours[key]:.2f} | {paper[key]:.2f} |" for key, label in names.items()]
    return "\n".join(
        [
            f"# Quality of {hand.capitalize()} grasps",
            "",
            f"graspd {PACKAGE_VERSION}, `{command}`: {rows[0]['n']} candidates on each of {len(rows)} objects, "
            f"real URDF, fidelity *standard*, seed {SEED}. Validator: MuJoCo, level *dexgraspbench*.",
            "",
            f"- Grasps that hold (GSR): **{total['gsr']:.3f}**; at half friction (*hard*): {total['gsr_hard']:.3f}.",
            f"- Objects with at least one such grasp (OSR): **{total['osr']:.2f}**; at half friction: "
            f"{total['osr_hard']:.2f}.",
            f"- Held grasps per second of two cores (SGS): **{total['sgs']:.1f}**; without the time of validation: "
            f"{total['sgs_without_validation']:.1f}.",
            f"- Of {total['robust_n']} grasps held at level *standard*, {total['robust_many']} hold in at least "
            f"{SHARE} "
            f"of {ROBUST_MODELS} perturbed models.",
            "",
            head,
            "| --- |" + " --: |" * len(PRINTED),
            *body,
            "",
            "Medians over the grasps of an object; the last row has rates over all grasps and means of the medians.",
            "",
            "- *GSR*: share of grasps that hold; *hard*: the same at half friction.",
            f"- *robust*: share of {ROBUST_MODELS} perturbed models in which a grasp holds; mean over grasps held at "
            "level *standard*.",
            "- *SGS*: held grasps per second of planning and validation at level *standard*; a second is two CPU "
            "seconds.",
            "- *PD*, *SPD*: penetration and self-penetration [mm]; *CDC*: contact distance consistency [mm].",
            "- *CA*: contact area [cm²]; *CA*, *ε* and *Vol* have a contact threshold of 5 mm and μ = 1; *IV*: "
            "intersection [cm³].",
            "- *SD*: simulated displacement [cm]; *D*: variance explained by the first principal component.",
            "",
            f"Means over the best {TOP} grasps of each object by ε, as in table 2 of the Fast-Grasp'D paper, which "
            "also "
            "uses YCB objects:",
            "",
            "| | graspd | Fast-Grasp'D |",
            "| --- | --: | --: |",
            *versus,
            f"| held under the unmodified protocol | {total['top_held']:.2f} | - |",
            "",
        ]
    )


def main() -> None:
    parser = cell_parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    args = parser.parse_args()
    for hand in args.hands:
        rows = []
        for cell in cells(args.data, args.work, hand, args.grasps, args.objects):
            rows.append(row(cell))
            sys.stderr.write(f"{hand} {cell.object_name}: GSR {rows[-1]['gsr']:.2f}, hard {rows[-1]['gsr_hard']:.2f}\n")
        total = whole(rows)
        command = f"python -m benchmarks.results_tables DATA --hands {hand}"
        write_json(args.out / f"quality-{hand}.json", {"hand": hand, "all": total, "objects": rows, "command": command})
        (args.out / f"quality-{hand}.md").write_text(markdown(hand, rows, total, command))


if __name__ == "__main__":
    main()
