"""The scores as a table in the layout of the paper's Table 3: grasps in, grasps out."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean, stdev
from typing import Any, Final

Row = dict[str, Any]

_HEADINGS: Final = {
    "contact_area_cm2": "CA cm²", "intersection_volume_cm3": "IV cm³", "epsilon": "ε", "wrench_volume": "Vol",
    "simulated_displacement_cm": "SD cm", "gsr": "GSR",
}  # fmt: skip


def markdown(rows: Sequence[Row]) -> str:
    """Two tables: figures of each source's grasps, and of what networks trained on them propose for unseen objects.

    Each cell of the second is the mean over the held-back objects and seeds, and the standard deviation over seeds.
    """
    return "\n".join([*_table(rows, "data", "data"), "", *_table(rows, "network", "trained on")])


def _table(rows: Sequence[Row], side: str, title: str) -> list[str]:
    some = [row for row in rows if row["side"] == side]
    lines = [f"| {title} | objects | grasps | " + " | ".join(_HEADINGS.values()) + " |", "| --- " + "| --: " * 8 + "|"]
    for name in dict.fromkeys(row["source"] for row in some):
        of_source = [row for row in some if row["source"] == name]
        seeds = {
            row.get("seed", 0): [r for r in of_source if r.get("seed", 0) == row.get("seed", 0)] for row in of_source
        }
        first = next(iter(seeds.values()))
        cells = [_cell([fmean(row[metric] for row in part) for part in seeds.values()]) for metric in _HEADINGS]
        lines.append(f"| {name} | {len(first)} | {sum(row['grasps'] for row in first)} | " + " | ".join(cells) + " |")
    return lines


def _cell(means: list[float]) -> str:
    return f"{fmean(means):.3g} ± {stdev(means):.2g}" if len(means) > 1 else f"{means[0]:.3g}"
