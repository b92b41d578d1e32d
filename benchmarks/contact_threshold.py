"""Figure 3 of Fast-Grasp'D with graspd's grasps: epsilon, wrench volume, contact area by threshold.

usage: python -m benchmarks.contact_threshold DATA_DIR [--work DIR] [--hands allegro ...] [--out DIR]
DATA_DIR holds hands/ and objects/. Writes contact-threshold.json and contact-threshold.png to `--out`. Values are means
over the 10 best grasps by epsilon (5 mm, friction 1) of each object; grasps come from the cells of `--work` (cells.py).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from benchmarks.cells import Cell, cell_parser, cells, write_json
from benchmarks.results_tables import PAPER, TOP, metrics
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.quality.table import measure

THRESHOLDS_MM = tuple(range(1, 11))
FRICTIONS = (1.0, 0.5)
#: Thresholds of the literature, drawn as lines: those of ContactOpt, of the paper and of DDGC.
MARKED_MM = {2: "ContactOpt", 5: "table 2", 9: "DDGC"}
PANELS = {
    "epsilon": ("ε", "epsilon", "radius of the largest ball in the wrench space"),
    "wrench_volume": ("Vol", "wrench_volume", "volume of the wrench space"),
    "ca_cm2": ("CA  [cm²]", "contact_area_cm2", "hand surface in contact"),
}
#: Colours of Okabe and Ito, suitable for colour blindness.
COLOURS = {"allegro": "#0072B2", "barrett": "#D55E00", "shadow": "#009E73"}
SHIFT = {"allegro": -0.13, "barrett": 0.0, "shadow": 0.13}
INK, FAINT = "#333333", "#9a9a9a"


def sweep(cell: Cell) -> dict[str, Any]:
    """Return means of metrics over the cell's best grasps at every threshold, by friction."""
    quality = cell.kept("metrics", lambda: metrics(cell))
    top = np.argsort(-np.array(quality["epsilon"]))[:TOP]
    parts = [
        Posture(part.hand_pose[top], part.joint_positions[top])
        for part in (cell.grasps.grasp, cell.grasps.pregrasp, cell.grasps.squeeze)
    ]
    grasps = GraspSet(parts[0], parts[1], parts[2], cell.grasps.stability_loss[top])
    found = {}
    for friction in FRICTIONS:
        thresholds = [mm * 1e-3 for mm in THRESHOLDS_MM]
        table = measure(cell.hand, cell.obj, grasps, friction=friction, thresholds_m=thresholds, every_volume=True)
        found[f"{friction:g}"] = {
            key: np.asarray(table[f"quality/{column}"]).mean(axis=0).tolist() for key, (_, column, _) in PANELS.items()
        }
    return found


def collect(args: argparse.Namespace) -> dict[str, Any]:
    """Return hand -> friction -> metric -> {mean, low, high} by threshold; low and high are quartiles."""
    out: dict[str, Any] = {}
    for hand in args.hands:
        found = []
        for cell in cells(args.data, args.work, hand, args.grasps, args.objects):
            found.append(cell.kept("thresholds", lambda cell=cell: sweep(cell)))  # type: ignore[misc]
            sys.stderr.write(f"{hand} {cell.object_name}\n")
        out[hand] = {"objects": len(found)}
        for friction in found[0]:
            values = {key: np.array([one[friction][key] for one in found]) for key in PANELS}
            out[hand][friction] = {
                key: {
                    "mean": v.mean(axis=0).tolist(),
                    "low": np.quantile(v, 0.25, axis=0).tolist(),
                    "high": np.quantile(v, 0.75, axis=0).tolist(),
                }
                for key, v in values.items()
            }
    return out


def draw(found: dict[str, Any], file: Path) -> None:
    plt.rcParams.update({"font.family": "DejaVu Sans", "font.size": 10, "axes.edgecolor": FAINT, "text.color": INK})
    figure, axes = plt.subplots(1, 3, figsize=(12.5, 5.0))
    for axis, key in zip(axes, PANELS, strict=True):
        panel(axis, key, found)
    figure.suptitle(
        "Grasp quality against contact threshold", x=0.045, y=0.975, ha="left", fontsize=14, fontweight="bold"
    )
    objects = " / ".join(sorted({str(one["objects"]) for one in found.values()}))
    said = f"means of the {TOP} best grasps by ε on each of {objects} objects"
    figure.text(0.985, 0.975, said, ha="right", va="top", color=FAINT, fontsize=10)
    figure.legend(handles=legend(found), loc="lower center", ncols=6, frameon=False, handlelength=2.4)
    figure.subplots_adjust(left=0.045, right=0.985, top=0.77, bottom=0.185, wspace=0.16)
    figure.savefig(file, dpi=160)
    plt.close(figure)


def panel(axis: Axes, key: str, found: dict[str, Any]) -> None:
    label, _, meaning = PANELS[key]
    for mm, name in MARKED_MM.items():
        axis.axvline(mm, color="#d8d8d8", linewidth=1, zorder=0)
        axis.text(mm, 1.012, name, transform=axis.get_xaxis_transform(), ha="center", color=FAINT, fontsize=8)
    for hand, by_friction in found.items():
        for friction, style in (("1", "-"), ("0.5", (0, (4, 2)))):
            if key == "ca_cm2" and friction != "1":
                continue
            values = by_friction[friction][key]
            axis.plot(THRESHOLDS_MM, values["mean"], color=COLOURS[hand], linestyle=style, linewidth=2)
        # Two hands have the same values in the paper: markers side by side show both.
        axis.plot(
            5 + SHIFT[hand],
            PAPER[hand][key],
            "o",
            markersize=7,
            markerfacecolor="white",
            markeredgewidth=1.8,
            color=COLOURS[hand],
            zorder=5,
        )
    axis.set_title(label, loc="left", fontsize=12, fontweight="bold", color=INK, pad=30)
    axis.text(0, 1.08, meaning, transform=axis.transAxes, color=FAINT, fontsize=9)
    axis.set_xlabel("contact threshold  [mm]", color=INK)
    axis.set_xlim(1, 10)
    axis.set_ylim(bottom=0)
    axis.set_xticks(THRESHOLDS_MM)
    axis.grid(axis="y", color="#ececec", linewidth=0.8)
    axis.set_axisbelow(True)
    axis.spines[["top", "right", "left"]].set_visible(False)
    axis.tick_params(length=0, colors=INK)


def legend(found: dict[str, Any]) -> list[Line2D]:
    hands = [Line2D([], [], color=COLOURS[hand], linewidth=2.5, label=hand.capitalize()) for hand in found]
    return [
        *hands,
        Line2D([], [], color=INK, linewidth=2, label="μ = 1"),
        Line2D([], [], color=INK, linewidth=2, linestyle=(0, (4, 2)), label="μ = 0.5"),
        Line2D([], [], color=INK, marker="o", markerfacecolor="white", linestyle="", label="Fast-Grasp'D, table 2"),
    ]


def main() -> None:
    parser = cell_parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    args = parser.parse_args()
    found = collect(args)
    kept = {"thresholds_mm": list(THRESHOLDS_MM), "top": TOP, "paper": PAPER, "hands": found}
    write_json(args.out / "contact-threshold.json", kept)
    draw(found, args.out / "contact-threshold.png")


if __name__ == "__main__":
    main()
