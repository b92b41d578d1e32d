"""The parts of the documentation that follow from the code: the tables of shards and settings.

A page holds them between `<!-- NAME -->` and `<!-- /NAME -->`; `python -m service.docs` writes them anew.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

from service.model.series import series_table
from service.settings import Settings
from service.store.columns import ATTRIBUTES, SCHEMAS, ShardKind


def schema_table(kind: ShardKind) -> str:
    """Markdown table of the datasets of a shard."""
    lines = ["| dataset | shape | type | unit | frame | meaning |", "| --- | --- | --- | --- | --- | --- |"]
    for path, column in SCHEMAS[kind].items():
        shape = ", ".join(column.shape.split())
        absent = " *(may be absent)*" if column.optional else ""
        lines.append(
            f"| `{path}` | ({shape}) | {column.dtype} | {column.units} | {column.frame} "
            f"| {column.description}{absent} |"
        )
    return "\n".join(lines)


def attributes_table() -> str:
    """Markdown table of the root attributes of shards."""
    lines = ["| attribute | of | type | meaning |", "| --- | --- | --- | --- |"]
    for name, one in ATTRIBUTES.items():
        lines.append(f"| `{name}` | {', '.join(one.kinds)} | {one.type} | {one.description} |")
    return "\n".join(lines)


def settings_table() -> str:
    """Markdown table of the environment variables."""
    lines = ["| variable | default | meaning |", "| --- | --- | --- |"]
    for name, field in Settings.model_fields.items():
        default = "" if field.default is None else f"`{field.default}`"
        lines.append(f"| `GRASPD_{name.upper()}` | {default} | {field.description} |")
    return "\n".join(lines)


PARTS: Final[dict[str, Callable[[], str]]] = {
    "attributes": attributes_table,
    "base": lambda: schema_table("base"),
    "scene": lambda: schema_table("scene"),
    "views": lambda: schema_table("views"),
    "settings": settings_table,
    "metrics": series_table,
}
PAGES: Final = ("docs/reference/settings.md", "docs/reference/dataset.md", "docs/reference/metrics.md")


def renewed(text: str) -> str:
    """The page with every marked part written anew."""
    for name, make in PARTS.items():
        pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
        text = pattern.sub(lambda found, make=make: f"{found[1]}{make()}\n{found[2]}", text)  # type: ignore[misc]
    return text


def main(root: Path) -> None:
    """Renew all pages under a checkout."""
    for page in PAGES:
        path = root / page
        path.write_text(renewed(path.read_text()))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path.cwd())
