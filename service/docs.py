"""Update of the documentation's tables and keyword stubs: `python -m graspd.service.docs`."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from graspd.service.model.domain import JobOptions
from graspd.service.model.local_options import LocalOptions
from graspd.service.model.options import Place, Row, keywords_of, rows
from graspd.service.model.series import SERIES
from graspd.service.settings import Settings
from graspd.service.store.columns import ATTRIBUTES, SCHEMAS, ShardKind


def _table(headings: str, rows: Iterable[Iterable[object]]) -> str:
    names = headings.split(", ")
    lines = [names, ["---"] * len(names), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def schema_table(kind: ShardKind) -> str:
    absent = {True: " *(may be absent)*", False: ""}
    cells = (
        (f"`{path}`", f"({', '.join(c.shape.split())})", c.dtype, c.units, c.frame, c.description + absent[c.optional])
        for path, c in SCHEMAS[kind].items()
    )
    return _table("dataset, shape, type, unit, frame, meaning", cells)


def attributes_table() -> str:
    cells = ((f"`{name}`", ", ".join(one.kinds), one.type, one.description) for name, one in ATTRIBUTES.items())
    return _table("attribute, of, type, meaning", cells)


def settings_table() -> str:
    cells = (
        (f"`GRASPD_{name.upper()}`", "" if field.default is None else f"`{field.default}`", field.description)
        for name, field in Settings.model_fields.items()
    )
    return _table("variable, default, meaning", cells)


def series_table() -> str:
    cells = (
        (f"`{one.name}`", one.kind, ", ".join(f"`{label}`" for label in one.labels), one.meaning, one.source)
        for one in SERIES.values()
    )
    return _table("series, type, labels, meaning, from", cells)


def options_table() -> str:
    job, local = rows(JobOptions, "job"), rows(LocalOptions, "synth")
    same = {row.name for row in local if any(_cells(row) == _cells(other) for other in job)}
    found = [(row, "both" if row.name in same else "job") for row in job]
    found += [(row, "here") for row in local if row.name not in same]
    order = list(LocalOptions.model_fields)
    found.sort(key=lambda one: order.index(one[0].name))
    tables = []
    for group in ("basic", "advanced"):
        cells = (
            (f"`{row.name}`", ", ".join(f"`{flag}`" for flag in row.flags), where, *_cells(row))
            for row, where in found
            if row.option.group == group
        )
        table = _table("option, command line, of, default, bounds, meaning", cells)
        tables.append(f"## {group.capitalize()}\n\n{table}")
    return "\n\n".join(tables)


def _cells(row: Row) -> tuple[str, str, str]:
    default = "" if row.default is False or row.default in (None, (), {}, "") else f"`{row.default}`"
    return default, row.range, row.meaning


def keywords_stub() -> str:
    parts = [
        '"""Keyword arguments of the options, written by `python -m graspd.service.docs`."""\n',
        "from collections.abc import Mapping, Sequence",
        "from pathlib import Path",
        "from typing import Any, Literal, TypedDict",
    ]
    tables: tuple[tuple[str, type[JobOptions], Place], ...] = (
        ("JobKeywords", JobOptions, "job"),
        ("SynthesizeKeywords", LocalOptions, "python"),
    )
    for title, model, place in tables:
        fields = [f"    {row.name}: {text}" for row, text in keywords_of(model, place)]
        parts.append("\n".join(["", f"class {title}(TypedDict, total=False):", *fields]))
    return "\n".join(parts) + "\n"


PARTS: Final[dict[str, Callable[[], str]]] = {
    "attributes": attributes_table,
    "base": lambda: schema_table("base"),
    "scene": lambda: schema_table("scene"),
    "views": lambda: schema_table("views"),
    "options": options_table,
    "settings": settings_table,
    "metrics": series_table,
}
PAGES: Final = tuple(f"docs/reference/{name}.md" for name in ("settings", "dataset", "metrics", "options"))
STUB: Final = "graspd/keywords.pyi"


def update_tables(text: str) -> str:
    for name, make in PARTS.items():
        pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
        text = pattern.sub(lambda found, make=make: f"{found[1]}{make()}\n{found[2]}", text)  # type: ignore[misc]
    return text


def main(root: Path) -> None:
    for page in PAGES:
        path = root / page
        path.write_text(update_tables(path.read_text()))
    (root / STUB).write_text(keywords_stub())


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path.cwd())
