"""Remaining failures: the worst objects of each hand, outcomes of their grasps, and pictures of some.

usage: python -m benchmarks.failures DATA_DIR [--work DIR] [--hands allegro ...] [--objects NAME ...] [--out FOLDER]
DATA_DIR holds hands/ and objects/. Candidates at fidelity standard are validated at level standard; interrupted runs
resume (cells.py). Writes failures.md, failures.json and a picture for each of the worst objects under `--out`/failures.
"""

from __future__ import annotations

import io
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.cells import SEED, Cell, cell_parser, cells, write_json
from graspd.service.model.version import STAGE_REVISIONS
from graspd.worker.control.postures import hold_forces
from graspd.worker.hands.pinch_postures import pinch_postures_of
from graspd.worker.quality.contact import contact_distance_consistency_mm
from graspd.worker.quality.probe import HAND_POINTS, OBJECT_POINTS, probe_of
from graspd.worker.quality.table import measure
from graspd.worker.rendering.pictures import grasp_pictures
from graspd.worker.rendering.sheets import contact_sheet
from graspd.worker.validation.validator import validate

#: Largest numbers of objects per hand, and of failed grasps per object.
WORST, SHOWN = 3, 3
EDGE = 260
#: A body is a shell if volume / (surface / 2) is less than this [mm]; convex pieces are at most 0.85 mm too thick.
THIN_MM = 8.0
#: An object is wide for a hand whose pads open to less than this multiple of the object's least extent.
ROOMY = 1.25
#: A cause of failure: MuJoCo's penetration minus the mesh's is larger by this [mm] than in held grasps.
PUSHED_MM = 0.3


def found_out(cell: Cell) -> dict[str, Any]:
    """Return verdict and figures of each grasp, and properties of object and hand that affect them."""
    grasps, hand, obj = cell.grasps, cell.hand, cell.obj
    verdicts = validate(hand, obj, grasps)
    columns = measure(hand, obj, grasps, thresholds_m=[0.005])
    probe = probe_of(hand, obj, hand_points=HAND_POINTS, object_points=OBJECT_POINTS)
    apart = contact_distance_consistency_mm(hand, probe.body_distance(probe.measure(grasps.grasp)))
    corners = obj.vertices[obj.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    return {
        "success": verdicts.success.tolist(),
        "reasons": verdicts.reasons,
        "margin": np.minimum(verdicts.margin, 1e3).tolist(),
        "engine_mm": verdicts.penetration_depth_mm.tolist(),
        "mesh_mm": columns["quality/penetration_depth_mm"].tolist(),
        "links": columns["quality/contact_links"].tolist(),
        "uneven_mm": apart.tolist(),
        "residual": hold_forces(hand, obj, grasps.grasp).residual.tolist(),
        "excess_mm": 1e3 * verdicts.excess_m,
        "pieces": verdicts.pieces,
        "thickness_mm": 2e3 * obj.volume / float(area),
        "least_extent_mm": 1e3 * float(np.ptp(obj.vertices, axis=0).min()),
        "widest_mm": 1e3 * pinch_postures_of(hand).widest,
    }


def kind(reason: str) -> str:
    words = {"displaced": "slips", "rotated": "turns", "lost while closing": "lost while closing"}
    return next((word for start, word in words.items() if reason.startswith(start)), reason)


def why(found: dict[str, Any]) -> str:
    """Return likely causes of a pair's failures, from its figures."""
    held = np.array(found["success"]) == 1
    lost = ~held
    said = []
    if found["least_extent_mm"] * ROOMY > found["widest_mm"]:
        said.append(
            f"the object is {found['least_extent_mm']:.0f} mm wide at its narrowest, and opposed pads open to at most "
            f"{found['widest_mm']:.0f} mm"
        )
    if found["thickness_mm"] < THIN_MM:
        said.append(
            f"the object is a shell of {found['thickness_mm']:.1f} mm, and its convex pieces are "
            f"{found['excess_mm']:.2f} mm too thick per side"
        )
    deeper = np.array(found["engine_mm"]) - np.array(found["mesh_mm"])
    if held.any() and np.median(deeper[lost]) > np.median(deeper[held]) + PUSHED_MM:
        said.append(
            f"penetration in MuJoCo is {np.median(deeper[lost]):.1f} mm ({_median(deeper[held], 1)}) larger than on "
            "the "
            "mesh, so the closing hand pushes the object away"
        )
    for name, text, unit, digits in (
        ("residual", "residual of the contact force balance at μ = 0.3 is", "", 3),
        ("uneven_mm", "distance between first and last finger contact", " mm", 1),
    ):
        values = np.array(found[name])
        if held.any() and np.median(values[lost]) > 1.5 * np.median(values[held]) + 1e-3:
            said.append(f"{text} {_median(values[lost], digits)}{unit} ({_median(values[held], digits)})")
    return "; ".join(said) or "no figure distinguishes failed from held grasps"


def _median(values: NDArray[np.float64], digits: int) -> str:
    return f"{np.median(values):.{digits}f}" if len(values) else "-"


def chosen(found: dict[str, Any]) -> list[int]:
    """Return rows of failures, one per common kind, then more of the first kind; then a held grasp."""
    kinds = [kind(reason) for reason in found["reasons"]]
    order = [name for name, _ in Counter(kinds).most_common() if name != "held"]
    rows = [kinds.index(name) for name in order[:SHOWN]]
    rows += [row for row, name in enumerate(kinds) if order and name == order[0] and row not in rows]
    return rows[:SHOWN] + ([kinds.index("held")] if "held" in kinds else [])


def picture(cell: Cell, found: dict[str, Any], file: Path) -> None:
    rows = chosen(found)
    grasp = cell.grasps.grasp.take(np.array(rows))
    drawn = grasp_pictures(cell.hand, cell.obj, grasp.hand_pose, grasp.joint_positions, (EDGE, EDGE), samples=8)[:, 0]
    captions = [[(f"margin {found['margin'][row]:.1f}", found["reasons"][row])] for row in rows]
    held = np.mean(found["success"])
    page = contact_sheet(drawn, captions, title=f"{cell.hand_name} on {cell.object_name}", subtitle=f"{held:.0%} hold")
    file.parent.mkdir(parents=True, exist_ok=True)
    few = Image.open(io.BytesIO(page)).convert("RGB").quantize(96, dither=Image.Dither.NONE)
    few.save(file, optimize=True)


def main() -> None:
    parser = cell_parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    args = parser.parse_args()
    lines = [
        "# Remaining failures\n",
        f"{args.grasps} candidates on each of {len(args.objects or []) or 'all'} objects at fidelity `standard`, seed "
        f"{SEED}, validated at level `standard` (revision {STAGE_REVISIONS['synthesize']} of synthesize). For each "
        f"hand, the page shows at most {WORST} objects, those with most failures. Pictures show the moment of contact: "
        "up to three failed grasps, then one that holds. *Margin*: largest ratio of a motion to its limit. Numbers "
        "below a table are medians over failed grasps; those in brackets are medians over held grasps. Made by "
        "`python -m benchmarks.failures DATA --objects ...`.\n",
    ]
    told: list[dict[str, Any]] = []
    drawn: set[Path] = set()
    for hand in args.hands:
        every = list(cells(args.data, args.work, hand, args.grasps, args.objects))
        figures = []
        for cell in every:
            figures.append(cell.kept("failures", lambda cell=cell: found_out(cell)))  # type: ignore[misc]
            sys.stderr.write(f"{hand}: {cell.object_name} {np.mean(figures[-1]['success']):.2f}\n")
        order = np.argsort([np.mean(found["success"]) for found in figures], kind="stable")
        lines += [
            f"## {hand}\n",
            "| object | held | lost while closing | rotated | displaced | penetration | other |",
            "| --- | --: | --: | --: | --: | --: | --: |",
        ]
        for at in order:
            counts = Counter(kind(reason) for reason in figures[at]["reasons"])
            named = ("held", "lost while closing", "turns", "slips", "penetration")
            numbers = [counts[name] for name in named]
            numbers.append(sum(counts.values()) - sum(numbers))
            lines.append(f"| {every[at].object_name} | {' | '.join(map(str, numbers))} |")
            told.append(
                {"hand": hand, "object": every[at].object_name, **dict(zip((*named, "other"), numbers, strict=True))}
            )
        lines.append("")
        for at in order[:WORST]:
            cell, found = every[at], figures[at]
            if all(found["success"]):
                break
            name = f"failures/{hand}-{cell.object_name}.png"
            picture(cell, found, args.out / name)
            drawn.add(args.out / name)
            lines += [
                f"**{cell.object_name}**, {100 * np.mean(found['success']):.0f} % hold: {why(found)}.\n",
                f"![{hand} on {cell.object_name}: failed grasps, then a held one]({name})\n",
            ]
    for older in set((args.out / "failures").glob("*.png")) - drawn:
        older.unlink()
    (args.out / "failures.md").write_text("\n".join(lines))
    write_json(args.out / "failures.json", told)


if __name__ == "__main__":
    main()
