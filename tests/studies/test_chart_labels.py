"""Words beside the points of a plot: none on another, on a point, or outside of its panel."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from matplotlib.figure import Figure

from graspd.studies.chart.figure import Label, place

CROWDS = {
    "beside each other": [(10.0, 0.98), (13.0, 0.95), (14.0, 0.93), (22.0, 0.94)],
    "above each other": [(5.0, 0.50), (5.0, 0.52), (5.0, 0.54), (5.1, 0.48)],
    "in the corners": [(1.0, 0.0), (100.0, 1.0), (1.0, 1.0), (100.0, 0.0)],
    "at the same place": [(3.0, 0.3), (3.0, 0.3), (3.0, 0.3)],
}


def drawn(points: list[tuple[float, float]]) -> tuple[Any, list[Any]]:
    figure = Figure(figsize=(5.0, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.set_xscale("log")
    axes.set_xlim(0.8, 130.0)
    axes.set_ylim(-0.07, 1.07)
    labels = [
        Label(axes, x, y, f"standard {n}", "black", y_bar=(y - 0.03, y + 0.03)) for n, (x, y) in enumerate(points)
    ]
    words = place(figure, labels)
    figure.draw_without_rendering()
    return axes, words


@pytest.mark.parametrize("crowd", CROWDS)
def test_no_word_lies_on_another_or_on_a_point_or_outside(crowd: str) -> None:
    axes, words = drawn(CROWDS[crowd])
    boxes = [word.get_window_extent() if word.arrow_patch is None else text_of(word) for word in words]
    assert len(boxes) == len(CROWDS[crowd])
    for one, other in itertools.combinations(boxes, 2):
        assert one.x1 <= other.x0 or other.x1 <= one.x0 or one.y1 <= other.y0 or other.y1 <= one.y0
    panel = axes.get_window_extent()
    for box in boxes:
        assert not any(box.contains(x, y) for x, y in axes.transData.transform(CROWDS[crowd]))
        assert panel.x0 - 1 <= box.x0 and box.x1 <= panel.x1 + 1 and panel.y0 - 1 <= box.y0 and box.y1 <= panel.y1 + 1


def text_of(word: Any) -> Any:
    """The word's box without the line that leads to it."""
    from matplotlib.text import Text

    return Text.get_window_extent(word)


def test_a_point_that_stands_alone_has_its_word_close_by_and_no_line() -> None:
    axes, (word,) = drawn([(10.0, 0.5)])
    box, point = word.get_window_extent(), axes.transData.transform((10.0, 0.5))
    assert word.arrow_patch is None
    assert 0 < box.x0 - point[0] < 15 and 0 < box.y0 - point[1] < 15


def test_a_point_without_a_word_is_kept_free_all_the_same() -> None:
    figure = Figure(figsize=(5.0, 4.0))
    axes = figure.subplots()
    # The second point lies where the first one's word would stand.
    axes.set_xlim(0, 10)
    axes.set_ylim(0, 10)
    (word,) = place(figure, [Label(axes, 5.0, 5.0, "here", "black"), Label(axes, 5.4, 5.4, "", "black")])
    assert not text_of(word).contains(*axes.transData.transform((5.4, 5.4)))
