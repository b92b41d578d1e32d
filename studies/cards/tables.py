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


def hands_table(card: Row) -> str:
    rows = [
        [
            hand["name"],
            hand["description"] or "-",
            hand["licence"] or "not recorded",
            hand["source"] or "not recorded",
            _code(hand["digest"]),
            _number(hand["dofs"]),
            _number(hand["fingertips"]),
            f"{hand['valid']:,}",
        ]
        for hand in card["composition"]["hands"]
    ]
    head = ("hand", "what", "licence", "source", "digest", "dofs", "fingertips", "valid grasps")
    return markdown(head, rows, words=5)


def objects_table(card: Row) -> str:
    rows = [
        [
            obj["name"],
            obj["licence"] or "not recorded",
            obj["source"] or "not recorded",
            _code(obj["digest"]),
            _size(obj["extents_m"]),
            "-" if obj["volume_m3"] is None else f"{1e6 * obj['volume_m3']:.0f}",
            f"{obj['valid']:,}",
        ]
        for obj in card["composition"]["objects"]
    ]
    return markdown(("object", "licence", "source", "digest", "size, mm", "cm³", "valid grasps"), rows, words=4)


def validity_table(card: Row) -> str:
    """Return a table by hand and in total: candidates, valid ones, rejections, rechecks, cost."""
    found = {**card["validity"]["by_hand"], "**all**": card["validity"]}
    rows = []
    for name, row in found.items():
        of_validated = interval(row["of_validated"]) if row["validated"] or not row["candidates"] else "not validated"
        each = 1000 * row["seconds"] / row["valid"] if row["valid"] and row["seconds"] else None
        rows.append(
            [
                name,
                f"{row['candidates']:,}",
                f"{row['valid']:,}",
                of_validated,
                _rejected(row["rejected"]),
                f"{row['rechecked']:,}",
                str(row["recheck_dropped"]) if row["rechecked"] else "-",
                interval(row["false_valid"]),
                "not recorded" if each is None else f"{each:,.0f}",
            ]
        )
    head = (
        "hand",
        "candidates",
        "valid",
        "valid of validated (95 %)",
        "why not",
        "rechecked",
        "overturned",
        "false valid (95 %)",
        "worker s per 1,000",
    )
    return markdown(head, rows)


def quality_table(card: Row) -> str:
    """Return the median and the range from the 5th to the 95th percentile, by hand."""
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
    """Return a row for each hand x object."""
    rows = []
    for cell in card["cells"]:
        median = cell["median"]
        rows.append(
            [
                cell["hand"],
                cell["object"],
                "-" if cell["asked"] is None else f"{cell['asked']:,}",
                f"{cell['candidates']:,}",
                f"{cell['valid']:,}",
                percent(cell["of_validated"]),
                *(_fixed(median.get(name), QUALITY_NAMES[name][1]) for name in _SHOWN),
                percent(cell["clear_of_table"]),
                _fixed(cell["diversity"], 2),
                percent(1 - cell["directions"]["empty"] / card["directions"]["cells"]) if cell["directions"] else "-",
                _bits(cell["directions"]),
                _bits(cell.get("types")),
                cell["missing_because"] or "",
            ]
        )
    head = [
        "hand",
        "object",
        "asked",
        "candidates",
        "valid",
        "of validated",
        *(QUALITY_NAMES[name][0] for name in _SHOWN),
        "clear of table",
        "D",
        "directions used",
        "entropy of directions, bit",
        "of types, bit",
        "missing because",
    ]
    if not any(row[-1] for row in rows):
        head, rows = head[:-1], [row[:-1] for row in rows]
    return markdown(head, rows, words=2)


_SHOWN: Final = (
    "epsilon",
    "contact_area_cm2",
    "intersection_volume_cm3",
    "penetration_depth_mm",
    "simulated_displacement_cm",
)


def interval(found: Row | None) -> str:
    """Return a share with its 95 % interval."""
    if found is None:
        return "not known"
    return f"{percent(found['share'])} ({percent(found['low'])} to {percent(found['high'])})"


def percent(value: float | None) -> str:
    if value is None:
        return "-"
    digits = 0 if (value >= 0.1 and round(value, 3) < 0.995) or value in (0, 1) else 1
    return f"{100 * value:.{digits}f} %"


def size(count: int) -> str:
    """Return bytes as readable text."""
    value, unit = float(count), 0
    while value >= 1000 and unit < len(_UNITS) - 1:
        value, unit = value / 1000, unit + 1
    return f"{value:.0f} {_UNITS[unit]}" if unit == 0 or value >= 100 else f"{value:.1f} {_UNITS[unit]}"


def _spread(cell: Row | None, digits: int) -> str:
    if cell is None:
        return "-"
    return f"{cell['median']:.{digits}f} ({cell['p5']:.{digits}f} to {cell['p95']:.{digits}f})"


def _rejected(rejected: Mapping[str, int] | None) -> str:
    """Return the outcomes of rejected candidates in words."""
    words = {
        "dropped": "dropped by the validator",
        "gate": "failed the gate",
        "diverged": "diverged",
        "not_robust": "held in too few models",
        "alike": "too like another",
    }
    parts = [f"{count:,} {words.get(why, why)}" for why, count in (rejected or {}).items() if count]
    return ", ".join(parts) or ("-" if rejected is not None else "not recorded")


def _fixed(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _bits(found: Row | None) -> str:
    return "-" if not found or "entropy_bits" not in found else f"{found['entropy_bits']:.2f}"


def _number(value: int | None) -> str:
    return "-" if value is None else str(value)


def _code(digest: str | None) -> str:
    return f"`{digest[:12]}`" if digest else "-"


def _size(extents: Sequence[float] | None) -> str:
    return "-" if extents is None else " x ".join(f"{1e3 * extent:.0f}" for extent in extents)
