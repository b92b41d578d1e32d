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

#: What a row tells of: a source's own grasps, a network's proposals, what comes of them.
DATA, PROPOSED, CARRIED_OUT = "data", "proposed", "carried out"
_TABLES: Final = {DATA: "data", PROPOSED: "trained on; as proposed", CARRIED_OUT: "trained on; carried out"}


def markdown(rows: Sequence[Row]) -> str:
    """Three tables: the sources' own grasps; what networks trained on them propose for unseen objects; and what comes
    of it when a hand carries it out.

    Cells are means over the objects; with several seeds the mean over them and their standard deviation.
    """
    parts = [_table(rows, side, title) for side, title in _TABLES.items() if any(row["side"] == side for row in rows)]
    return "\n\n".join("\n".join(lines) for lines in parts)


def _table(rows: Sequence[Row], side: str, title: str) -> list[str]:
    some = [row for row in rows if row["side"] == side]
    lines = [
        f"| {title} | objects | pictures | grasps | " + " | ".join(_HEADINGS.values()) + " |",
        "| --- " + "| --: " * 9 + "|",
    ]
    for name in dict.fromkeys(row["source"] for row in some):
        seeds: dict[int, list[Row]] = {}
        for row in some:
            if row["source"] == name:
                seeds.setdefault(row.get("seed", 0), []).append(row)
        first = next(iter(seeds.values()))
        cells = [_cell([fmean(row[metric] for row in part) for part in seeds.values()]) for metric in _HEADINGS]
        counts = [len(first), first[0].get("pictures", "–"), sum(row["grasps"] for row in first)]
        lines.append(f"| {name} | " + " | ".join([*map(str, counts), *cells]) + " |")
    return lines


def _cell(means: list[float]) -> str:
    return f"{fmean(means):.3g} ± {stdev(means):.2g}" if len(means) > 1 else f"{means[0]:.3g}"
