"""Tables of scores: by source, on unseen objects and faces, and by object."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import fmean, stdev
from typing import Any, Final

from examples.train_grasp_predictor.evaluation import FACE, OBJECT

Row = dict[str, Any]

#: Column -> kind of exam, key of the score.
_COLUMNS: Final = {
    "lift": (OBJECT, "lift"),
    "first proposal": (OBJECT, "best"),
    "half friction": (OBJECT, "hard"),
    "into the table": (OBJECT, "table"),
    "ε": (OBJECT, "epsilon"),
    "lift, unseen faces": (FACE, "lift"),
    "half friction, faces": (FACE, "hard"),
}


def markdown(rows: Sequence[Row]) -> str:
    """Return a table by source and a table by object for each hand. Cells by object are means over seeds.
    Cells by source are means over objects with equal weights, then mean ± standard deviation over seeds."""
    parts = []
    for hand in dict.fromkeys(row["hand"] for row in rows):
        mine = [row for row in rows if row["hand"] == hand]
        parts += [f"**{hand}**", "\n".join(_sources(mine)), "\n".join(_objects(mine))]
    return "\n\n".join(parts)


def _sources(rows: Sequence[Row]) -> Iterator[str]:
    yield "| trained on | grasps | pictures | " + " | ".join(_COLUMNS) + " |"
    yield "| --- | --: | --: |" + " --: |" * len(_COLUMNS)
    for source in dict.fromkeys(row["source"] for row in rows):
        mine = [row for row in rows if row["source"] == source]
        cells = [_cell([_mean(part, kind, name) for part in _by_seed(mine)]) for kind, name in _COLUMNS.values()]
        counts = (mine[0].get("grasps") or "–", mine[0].get("views", "–"))
        yield f"| {source} | {counts[0]} | {counts[1]} | " + " | ".join(cells) + " |"


def _objects(rows: Sequence[Row]) -> Iterator[str]:
    found = dict.fromkeys((row["kind"], row["object"]) for row in rows)
    objects = sorted(found, key=lambda pair: pair[0] != OBJECT)
    sources = list(dict.fromkeys(row["source"] for row in rows))
    yield "| lift | " + " | ".join(sources) + " |"
    yield "| --- |" + " --: |" * len(sources)
    for kind, name in objects:
        cells = []
        for source in sources:
            mine = [row["lift"] for row in rows if (row["source"], row["kind"], row["object"]) == (source, kind, name)]
            cells.append(f"{fmean(mine):.2f}" if mine else "–")
        yield f"| {name}{', unseen face' * (kind == FACE)} | " + " | ".join(cells) + " |"


def _by_seed(rows: Sequence[Row]) -> list[list[Row]]:
    seeds: dict[int, list[Row]] = {}
    for row in rows:
        seeds.setdefault(row["seed"], []).append(row)
    return list(seeds.values())


def _mean(rows: Sequence[Row], kind: str, name: str) -> float | None:
    found = [row[name] for row in rows if row["kind"] == kind and name in row]
    return fmean(found) if found else None


def _cell(means: Sequence[float | None]) -> str:
    known = [value for value in means if value is not None]
    if not known:
        return "–"
    return f"{fmean(known):.2f} ± {stdev(known):.2f}" if len(known) > 1 else f"{known[0]:.2f}"
