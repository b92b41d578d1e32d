"""A card as a page: `README.md` with a YAML head for dataset hubs, from templates of this folder."""

import json
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Mapping, Sequence
from statistics import median_high
from typing import Any, Final

import numpy as np

from graspd.api.formatting import size
from graspd.service.model.metrics import GRASP_METRICS
from graspd.studies.figures import TEMPLATES, markdown_table
from graspd.worker.quality import gate as gates

Row = Mapping[str, Any]
#: Size classes of dataset hubs, and their limits.
_SIZES: Final = ("n<1K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "1M<n<10M", "n>10M")
_LIMITS: Final = tuple(10**power for power in range(3, 8))
#: Largest number of objects of a table that is not collapsed.
_UNFOLDED: Final = 20
_REJECTED: Final = {
    "dropped": "rejected by the validator",
    "gate": "failed the gate",
    "not_robust": "held in too few models",
    "alike": "near-duplicates",
}
#: A direction is preferred above this multiple of its share under uniform directions.
_PEAKED: Final = 1.25
#: Metrics in the table of cells.
_MEDIANS: Final = (
    "epsilon",
    "contact_area_cm2",
    "intersection_volume_cm3",
    "penetration_depth_mm",
    "simulated_displacement_cm",
)


def render_card(card: Row, plots: Mapping[str, str], publication: Row | None = None) -> str:
    """Return the whole page; `plots` are file names and captions.
    A `publication` has the `name` to load, `configs` of tables, `tars`, and the `unknown` licences."""
    return TEMPLATES.get_template("cards/page.md.j2").render(
        card,
        plots=plots,
        publication=publication,
        head=yaml_head(card, publication),
        findings=findings(card),
        quality_table=quality_table(card),
        medians=[(one.name, one.heading, one.digits or 0) for one in GRASP_METRICS if one.name in _MEDIANS],
        unfolded=_UNFOLDED,
        gate=f"penetration at most {gates.MAX_PENETRATION_MM:g} mm, self-penetration at most "
        f"{gates.MAX_SELF_PENETRATION_MM:g} mm, at least {gates.MIN_CONTACT_LINKS} links in contact",
    )


def render_croissant(card: Row, files: Sequence[Row], tables: Mapping[str, Mapping[str, tuple[str, str]]]) -> str:
    """Return the Croissant file; `files` have name, size and sha256, columns type and shape ("": scalar)."""
    return TEMPLATES.get_template("cards/croissant.json.j2").render(card, files=files, tables=tables)


def yaml_head(card: Row, publication: Row | None = None) -> dict[str, Any]:
    """Return the YAML head as JSON values, which are valid YAML."""
    made = card["composition"]
    licence = card["licence"] or ("unknown" if publication else "")
    tags = ["grasping", "dexterous-manipulation", "synthetic", "graspd", *(hand["name"] for hand in made["hands"])]
    return {
        "pretty_name": card["name"],
        **({"license": licence.lower()} if licence else {}),
        "task_categories": ["robotics"],
        "size_categories": [_SIZES[bisect_right(_LIMITS, made["valid"])]],
        "annotations_creators": ["machine-generated"],
        "tags": list(dict.fromkeys(tags)),
        **({"configs": publication["configs"]} if publication else {}),
    }


def findings(card: Row) -> list[str]:
    """Return the findings of a card's content as sentences in Markdown, with figures."""
    values = {**_elevation_findings(card), "difficult": _difficult_cells(card)}
    lines = TEMPLATES.get_template("cards/findings.md.j2").render(card, **values).splitlines()
    return [line for line in lines if line]


def _difficult_cells(card: Row) -> list[Row]:
    """Return cells with less than half of the median yield of their hand, the lowest yields first."""
    yields = defaultdict(list)
    rows = [cell for cell in card["cells"] if cell["of_validated"] is not None]
    for cell in rows:
        yields[cell["hand"]].append(cell["of_validated"])
    low = [cell for cell in rows if cell["of_validated"] < median_high(yields[cell["hand"]]) / 2]
    return sorted(low, key=lambda cell: cell["of_validated"])


def _elevation_findings(card: Row) -> dict[str, Any]:
    """Compare elevations of palms over the table with directions drawn uniformly on the sphere.
    Return those `preferred`, with their share and the expected one, and the share `from_above` of clear pairs."""
    every, clear = (
        np.sum([sums[name] for sums in card["elevation"].values()] or [[0]], axis=0) for name in ("all", "clear")
    )
    edges = np.linspace(-90, 90, len(every) + 1)
    middles = (edges[1:] + edges[:-1]) / 2
    even = np.diff(np.sin(np.radians(edges))) / 2
    preferred = []
    for what, chosen in (("10° of the horizontal", abs(middles) < 10), ("20° of the vertical", abs(middles) > 70)):
        found, expected = every[chosen].sum() / max(1, every.sum()), even[chosen].sum()
        if found > _PEAKED * expected:
            preferred.append((what, found, expected))
    return {"preferred": preferred, "from_above": clear[middles > 45].sum() / clear.sum() if clear.any() else None}


def quality_table(card: Row) -> str:
    """Return the distribution of each metric by hand, in Markdown."""
    hands = list(card["quality"])
    rows, missing = [], []
    for metric in GRASP_METRICS:
        if metric.digits is None:
            continue
        found = [card["quality"][hand].get(metric.name) for hand in hands]
        if any(found):
            rows.append([metric.heading, *(_percentile_text(one, metric.digits) for one in found)])
        else:
            missing.append(metric.heading)
    table = markdown_table(" | ".join(["quality", *hands]), rows)
    return table + (f"\n\nNot measured: {', '.join(missing)}." if missing else "")


def _percentile_text(found: Row | None, digits: int) -> str:
    if found is None:
        return "-"
    return f"{found['median']:.{digits}f} ({found['p5']:.{digits}f} to {found['p95']:.{digits}f})"


def cell_text(text: str | None, missing: str = "not recorded") -> str:
    return (text or missing).replace("|", "\\|").replace("\n", " ")


def percent(value: float | None) -> str:
    if value is None:
        return "-"
    digits = 0 if (value >= 0.1 and round(value, 3) < 0.995) or value in (0, 1) else 1
    return f"{100 * value:.{digits}f} %"


def format_fixed(value: float | None, digits: int = 0) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _count(number: int, what: str = "") -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}" if what else f"{number:,}"


def _rejected(rejected: Mapping[str, int] | None) -> str:
    parts = [f"{count:,} {_REJECTED.get(why, why)}" for why, count in (rejected or {}).items() if count]
    return ", ".join(parts) or ("-" if rejected is not None else "not recorded")


TEMPLATES.filters |= {
    "cell": cell_text,
    "count": _count,
    "fixed": format_fixed,
    "general": "{:g}".format,
    "interval": lambda found: (
        f"{percent(found['share'])} ({percent(found['low'])} to {percent(found['high'])})" if found else "unknown"
    ),
    "json": lambda value, indent=None: json.dumps(value, ensure_ascii=False, indent=indent),
    "letters": lambda name: "".join(letter for letter in name if letter.isalnum()) or "dataset",
    "millimetres": lambda extents: " x ".join(f"{1e3 * extent:.0f}" for extent in extents or ()) or "-",
    "percent": percent,
    "rejected": _rejected,
    "size": size,
}
