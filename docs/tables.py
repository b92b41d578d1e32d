"""Update of generated tables in the docs, and of keyword stubs: `python -m docs.tables`."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable
from itertools import starmap
from pathlib import Path
from typing import Final

from graspd.service.model.domain import JobOptions
from graspd.service.model.local_options import LocalOptions
from graspd.service.model.options import OptionRow, keywords_of, option_rows
from graspd.service.model.series import SERIES
from graspd.service.settings import Settings
from graspd.service.store.columns import ATTRIBUTES, SCHEMAS, Column, ShardKind


def _table(headings: str, rows: Iterable[Iterable[object]]) -> str:
    names = headings.split(", ")
    lines = [names, ["---"] * len(names), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def schema_table(kind: ShardKind) -> str:
    def cells(path: str, column: Column) -> tuple[str, ...]:
        meaning = column.description + " *(may be absent)*" * column.optional
        return f"`{path}`", f"({', '.join(column.shape.split())})", column.dtype, column.units, column.frame, meaning

    return _table("dataset, shape, type, unit, frame, meaning", starmap(cells, SCHEMAS[kind].items()))


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
    job, local = option_rows(JobOptions, "job"), option_rows(LocalOptions, "synth")
    same = {row.name for row in local if any(_cells(row) == _cells(other) for other in job)}
    found = [(row, "both" if row.name in same else "job") for row in job]
    found += [(row, "here") for row in local if row.name not in same]
    order = list(LocalOptions.model_fields)
    found.sort(key=lambda one: order.index(one[0].name))
    tables: dict[str, list[tuple[str, ...]]] = {"basic": [], "advanced": []}
    for row, where in found:
        flags = ", ".join(f"`{flag}`" for flag in row.flags)
        tables[row.option.group].append((f"`{row.name}`", flags, where, *_cells(row)))
    headings = "option, command line, of, default, bounds, meaning"
    return "\n\n".join(f"## {group.capitalize()}\n\n{_table(headings, cells)}" for group, cells in tables.items())


def _cells(row: OptionRow) -> tuple[str, str, str]:
    default = "" if row.default is False or row.default in (None, (), {}, "") else f"`{row.default}`"
    return default, row.range, row.meaning


def keywords_stub() -> str:
    parts = [
        '"""Keyword arguments of the options, written by `python -m docs.tables`."""\n',
        "from collections.abc import Mapping, Sequence",
        "from pathlib import Path",
        "from typing import Any, Literal, TypedDict",
    ]
    job, python = keywords_of(JobOptions, "job"), keywords_of(LocalOptions, "python")
    for title, keywords in (("JobKeywords", job), ("SynthesizeKeywords", python)):
        parts += [
            "",
            f"class {title}(TypedDict, total=False):",
            *(_keyword_line(row.name, text) for row, text in keywords),
        ]
    return "\n".join(parts) + "\n"


def _keyword_line(name: str, text: str) -> str:
    """Return the line of a keyword, wrapped as by ruff."""
    line = f"    {name}: {text}"
    if len(line) <= _WIDTH:
        return line
    head, choices = line.removesuffix("]").split("[", 1)
    return "\n        ".join([f"{head}[", *(f"{choice}," for choice in choices.split(", "))]) + "\n    ]"


PARTS: Final[dict[str, Callable[[], str]]] = {
    "attributes": attributes_table,
    "base": lambda: schema_table("base"),
    "scene": lambda: schema_table("scene"),
    "views": lambda: schema_table("views"),
    "episodes": lambda: schema_table("episodes"),
    "options": options_table,
    "settings": settings_table,
    "metrics": series_table,
}
PAGES: Final = tuple(f"docs/reference/{name}.md" for name in ("settings", "dataset", "metrics", "options"))
STUB: Final = "graspd/keywords.pyi"
_WIDTH: Final = 120


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
