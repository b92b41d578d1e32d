"""Tables of a card, in Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from graspd.service.model.metrics import GRASP_METRICS

Row = Mapping[str, Any]

#: Column, name, digits.
QUALITY_NAMES: Final = {
    metric.name: (metric.heading, metric.digits) for metric in GRASP_METRICS if metric.digits is not None
}
_UNITS: Final = ("B", "kB", "MB", "GB", "TB")


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]], *, words: int = 1) -> str:
    """Return a table; its first `words` columns are text, the others numbers."""
    rule = ["---"] * words + ["--:"] * (len(head) - words)
    lines = [head, rule, *([cell.replace("|", "\\|").replace("\n", " ") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _by_heading(rows: Sequence[Mapping[str, str]], *, words: int = 1) -> str:
    return markdown(list(rows[0]), [list(row.values()) for row in rows], words=words)


def hands_table(card: Row) -> str:
    rows = [
        {
            "hand": hand["name"],
            "what": hand["description"] or "-",
            **_origin(hand),
            "dofs": _number(hand["dofs"]),
            "fingertips": _number(hand["fingertips"]),
            "valid grasps": f"{hand['valid']:,}",
        }
        for hand in card["composition"]["hands"]
    ]
    return _by_heading(rows, words=5)


def objects_table(card: Row) -> str:
    rows = [
        {
            "object": obj["name"],
            **_origin(obj),
            "size, mm": _size(obj["extents_m"]),
            "cm³": "-" if obj["volume_m3"] is None else f"{1e6 * obj['volume_m3']:.0f}",
            "valid grasps": f"{obj['valid']:,}",
        }
        for obj in card["composition"]["objects"]
    ]
    return _by_heading(rows, words=4)


def _origin(asset: Row) -> dict[str, str]:
    known = {key: asset[key] or "not recorded" for key in ("licence", "source")}
    return {**known, "digest": f"`{asset['digest'][:12]}`" if asset["digest"] else "-"}


def validity_table(card: Row) -> str:
    found = {**card["validity"]["by_hand"], "**all**": card["validity"]}
    rows = []
    for name, row in found.items():
        of_validated = interval(row["of_validated"]) if row["validated"] or not row["candidates"] else "not validated"
        each = 1000 * row["seconds"] / row["valid"] if row["valid"] and row["seconds"] else None
        rows.append(
            {
                "hand": name,
                "candidates": f"{row['candidates']:,}",
                "valid": f"{row['valid']:,}",
                "valid of validated (95 %)": of_validated,
                "rejected": _rejected(row["rejected"]),
                "rechecked": f"{row['rechecked']:,}",
                "overturned": str(row["recheck_dropped"]) if row["rechecked"] else "-",
                "false valid (95 %)": interval(row["false_valid"]),
                "worker s per 1,000": "not recorded" if each is None else f"{each:,.0f}",
            }
        )
    return _by_heading(rows)


def quality_table(card: Row) -> str:
    hands = list(card["quality"])
    rows = []
    for name, (title, digits) in QUALITY_NAMES.items():
        cells = [card["quality"][hand].get(name) for hand in hands]
        if any(cells):
            rows.append([title, *(_spread(cell, digits) for cell in cells)])
    missing = [
        title for name, (title, _) in QUALITY_NAMES.items() if not any(name in card["quality"][h] for h in hands)
    ]
    note = f"\n\nNot measured: {', '.join(missing)}." if missing else ""
    return markdown(("quality", *hands), rows) + note


def cells_table(card: Row) -> str:
    rows = []
    for cell in card["cells"]:
        used = cell["directions"] and 1 - cell["directions"]["empty"] / card["directions"]["cells"]
        row = {
            "hand": cell["hand"],
            "object": cell["object"],
            "wanted": "-" if cell["asked"] is None else f"{cell['asked']:,}",
            "candidates": f"{cell['candidates']:,}",
            "valid": f"{cell['valid']:,}",
            "valid of validated": percent(cell["of_validated"]),
        }
        for name in _SHOWN:
            title, digits = QUALITY_NAMES[name]
            row[title] = _fixed(cell["median"].get(name), digits)
        row |= {
            "clear of table": percent(cell["clear_of_table"]),
            "D": _fixed(cell["diversity"], 2),
            "share of directions used": percent(used),
            "entropy of directions, bit": _bits(cell["directions"]),
            "entropy of grasp types, bit": _bits(cell["types"]),
        }
        if any(one["missing_because"] for one in card["cells"]):
            row["missing because"] = cell["missing_because"] or ""
        rows.append(row)
    return _by_heading(rows, words=2)


_SHOWN: Final = (
    "epsilon",
    "contact_area_cm2",
    "intersection_volume_cm3",
    "penetration_depth_mm",
    "simulated_displacement_cm",
)


def interval(found: Row | None) -> str:
    if found is None:
        return "unknown"
    return f"{percent(found['share'])} ({percent(found['low'])} to {percent(found['high'])})"


def percent(value: float | None) -> str:
    if value is None:
        return "-"
    digits = 0 if (value >= 0.1 and round(value, 3) < 0.995) or value in (0, 1) else 1
    return f"{100 * value:.{digits}f} %"


def size(count: int) -> str:
    value, unit = float(count), 0
    while value >= 1000 and unit < len(_UNITS) - 1:
        value, unit = value / 1000, unit + 1
    return f"{value:.0f} {_UNITS[unit]}" if unit == 0 or value >= 100 else f"{value:.1f} {_UNITS[unit]}"


def _spread(cell: Row | None, digits: int) -> str:
    if cell is None:
        return "-"
    return f"{cell['median']:.{digits}f} ({cell['p5']:.{digits}f} to {cell['p95']:.{digits}f})"


def _rejected(rejected: Mapping[str, int] | None) -> str:
    words = {
        "dropped": "rejected by the validator",
        "gate": "failed the gate",
        "diverged": "diverged",
        "not_robust": "held in too few models",
        "alike": "near-duplicates",
    }
    parts = [f"{count:,} {words.get(why, why)}" for why, count in (rejected or {}).items() if count]
    return ", ".join(parts) or ("-" if rejected is not None else "not recorded")


def _fixed(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _bits(found: Row | None) -> str:
    return "-" if not found or "entropy_bits" not in found else f"{found['entropy_bits']:.2f}"


def _number(value: int | None) -> str:
    return "-" if value is None else str(value)


def _size(extents: Sequence[float] | None) -> str:
    return "-" if extents is None else " x ".join(f"{1e3 * extent:.0f}" for extent in extents)
