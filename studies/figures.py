"""Layout that all studies share: figures, their colours, and pages and tables in Markdown."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined

COLOURS: Final = ("#0f766e", "#b45309", "#4338ca", "#be123c", "#4d7c0f", "#6b7280", "#a21caf", "#0369a1")
INK: Final = "#1f2937"
#: Templates of pages. These are Markdown, where only cells of tables need escapes.
TEMPLATES: Final = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=False,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
    extensions=["jinja2.ext.do"],
)


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure of this size [inch]."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def plain_axes(axes: Any, *, grid_below: bool = False) -> None:
    """Add a faint grid, with `grid_below` below all else, and remove the upper and the right line."""
    axes.grid(alpha=0.25)
    if grid_below:
        axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def markdown_table(headings: str, rows: Iterable[Sequence[object]], *, left: int = 1) -> str:
    """Return a table; | separates `headings`; the first `left` columns align left, others right."""
    sides = ["---"] * left + ["--:"] * (headings.count(" | ") + 1 - left)
    return "\n".join(f"| {' | '.join(map(str, row))} |" for row in ([headings], sides, *rows))
