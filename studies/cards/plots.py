"""Plots of a card."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from graspd.service.model.metrics import GRASP_METRICS
from graspd.studies.cards.tally import Tally, cell_counts
from graspd.studies.figures import COLOURS, INK, new_figure, plain_axes

Row = Mapping[str, Any]
_NAMED: Final = 40  # largest number of objects of a matrix that shows names and numbers
_PANELS: Final = 6  # largest number of panels: the first hands get one each
#: Title, column, and whether the axis ends at the 99th percentile.
_QUALITIES: Final = tuple(
    (metric.heading, metric.name, metric.plot == "cut") for metric in GRASP_METRICS if metric.plot != "no"
)
_DPI: Final = 110


def draw(card: Row, tally: Tally, folder: Path) -> dict[str, str]:
    """Write all plots that have data; return their captions by file name, in the order of the card."""
    plots: tuple[tuple[str, str, Callable[[Row, Tally], Any]], ...] = (
        ("yield.png", "Valid share of validated grasps, by hand and object", _plot_yields),
        ("quality.png", "Distribution of each quality over the valid grasps, by hand", _plot_qualities),
        ("directions.png", "Approach directions of the palm, by hand", _plot_directions),
        (
            "table.png",
            "Share of the valid grasps that are clear of the table in at least one scene",
            _plot_table_scenes,
        ),
        ("joints.png", "Range that each joint uses between its limits", _plot_joints),
        ("sizes.png", "Valid share of validated grasps over the size of the object", _plot_sizes),
    )
    written = {}
    for name, shows, make in plots:
        figure = make(card, tally)
        (folder / name).unlink(missing_ok=True)
        if figure is not None:
            figure.savefig(folder / name, dpi=_DPI)
            written[name] = shows
    return written


def _names(card: Row, what: str) -> list[str]:
    return [asset["name"] for asset in card["composition"][what]]


def _plot_yields(card: Row, tally: Tally) -> Any:
    hands, objects = _names(card, "hands"), _names(card, "objects")
    shares = np.full((len(objects), len(hands)), np.nan)
    rows = {(cell["hand"], cell["object"]): cell for cell in card["cells"] if cell["of_validated"] is not None}
    for (hand, obj), cell in rows.items():
        shares[objects.index(obj), hands.index(hand)] = cell["of_validated"]
    if not rows:
        return None
    named = len(objects) <= _NAMED
    figure = new_figure(2.6 + 1.25 * len(hands), 1.2 + (0.3 * len(objects) if named else 8))
    axes = figure.add_subplot()
    image = axes.imshow(shares, cmap="YlGnBu", vmin=0, vmax=1, aspect="auto", interpolation="nearest")
    axes.set_xticks(range(len(hands)), hands)
    axes.set_yticks(range(len(objects)) if named else [], objects if named else [])
    axes.set_title(f"{card['name']}: valid of validated (grasps)", loc="left", fontsize=10)
    for (hand, obj), cell in rows.items() if named else ():
        x, y, share = hands.index(hand), objects.index(obj), cell["of_validated"]
        text, colour = f"{100 * share:.0f} %  ({cell['valid']})", "white" if share > 0.6 else INK
        axes.text(x, y, text, ha="center", va="center", fontsize=8, color=colour)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    figure.colorbar(image, ax=axes, label="valid share of validated grasps", shrink=0.8)
    return figure


def _plot_qualities(card: Row, tally: Tally) -> Any:
    hands = _names(card, "hands")
    shown = [entry for entry in _QUALITIES if any(entry[1] in card["quality"][hand] for hand in hands)]
    if not shown:
        return None
    lines = -(-len(shown) // 3)
    figure = new_figure(10, 2.7 * lines + 0.4)
    panels = list(figure.subplots(lines, 3, squeeze=False).flat)
    for axes, (title, name, cut) in zip(panels, shown, strict=False):
        columns = {hand: values[np.isfinite(values)] for hand in hands for values in [tally.of_hand(hand).column(name)]}
        every = np.concatenate(list(columns.values()))
        top = float(np.percentile(every, 99) if cut else every.max()) or 1.0
        bins = np.linspace(0, top, 41)
        for number, (hand, values) in enumerate(columns.items()):
            if len(values):
                weights = np.full(len(values), 100 / len(values))
                style = {"color": COLOURS[number % len(COLOURS)], "histtype": "step", "linewidth": 1.5}
                axes.hist(np.minimum(values, top), bins, weights=weights, label=hand, **style)
        axes.set_xlabel(f"{title} (last bin: all above)" if cut else title, fontsize=9)
        axes.tick_params(labelsize=8)
        plain_axes(axes, grid_below=True)
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    figure.supylabel("% of the hand's valid grasps", fontsize=9)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=8, frameon=False)
    return figure


def _plot_directions(card: Row, tally: Tally) -> Any:
    """Plot directions of palms in the object's frame, and by elevation over the table.
    The top row has the former, the bottom row the latter."""
    hands = [hand for hand in _names(card, "hands") if card["directions"]["by_hand"][hand]][:_PANELS]
    if not hands:
        return None
    with_table = bool(card["elevation"])
    figure = new_figure(max(4.0, 3.6 * len(hands)), 4.9 if with_table else 2.6)
    grid = figure.add_gridspec(2 if with_table else 1, len(hands), height_ratios=[1, 1.1] if with_table else [1])
    bands, sectors = 12, 24
    latitudes = np.arcsin(np.linspace(-1, 1, bands + 1))
    longitudes = np.linspace(-np.pi, np.pi, sectors + 1)
    below = None
    for column, hand in enumerate(hands):
        axes = figure.add_subplot(grid[0, column], projection="mollweide")
        vectors = tally.of_hand(hand).directions()
        density = cell_counts(vectors, bands, sectors) * bands * sectors / len(vectors)
        mesh = axes.pcolormesh(longitudes, latitudes, density, cmap="magma", vmin=0, vmax=3, rasterized=True)
        axes.set(xticklabels=[], yticklabels=[])
        axes.grid(alpha=0.2)
        axes.set_title(hand, fontsize=10)
        if with_table and hand in card["elevation"]:
            below = figure.add_subplot(grid[1, column], sharey=below)
            _plot_elevations(below, card["elevation"][hand], first=column == 0)
    figure.colorbar(mesh, ax=figure.axes[-1 if not with_table else -2], shrink=0.7, label="1: uniform", extend="max")
    figure.suptitle(
        "top: object's frame, z up; bottom: elevation over the table", fontsize=9, color=INK, x=0.01, ha="left"
    )
    return figure


def _plot_elevations(axes: Any, sums: Mapping[str, Sequence[int]], *, first: bool) -> None:
    edges = np.linspace(-90, 90, len(sums["all"]) + 1)
    for name, colour, label in (("all", "#cbd5e1", "all pairs"), ("clear", COLOURS[0], "clear of the table")):
        axes.stairs(sums[name], edges, fill=True, color=colour, label=label)
    # Expected counts per bin for directions drawn uniformly on the sphere.
    even = np.diff(np.sin(np.radians(edges))) / 2 * sum(sums["all"])
    axes.stairs(even, edges, color=INK, linestyle="--", linewidth=1, label="uniform directions")
    axes.set_xticks([-90, -45, 0, 45, 90], ["below", "-45°", "side", "45°", "above"], fontsize=8)
    axes.tick_params(labelsize=8)
    plain_axes(axes, grid_below=True)
    if first:
        axes.set_ylabel("pairs of grasp and scene", fontsize=9)
        axes.figure.legend(loc="outside lower left", ncols=3, frameon=False, fontsize=8)


def _plot_table_scenes(card: Row, tally: Tally) -> Any:
    hands, objects = _names(card, "hands"), _names(card, "objects")
    rows = [cell for cell in card["cells"] if cell["clear_of_table"] is not None]
    if not rows:
        return None
    order = sorted(objects, key=lambda obj: (card["table"]["by_object"][obj]["of_grasps"] or {"share": 0})["share"])
    named = len(objects) <= _NAMED
    figure = new_figure(7.5, 1.3 + (0.28 * len(objects) if named else 7))
    axes = figure.add_subplot()
    for number, hand in enumerate(hands):
        own = [cell for cell in rows if cell["hand"] == hand]
        places = [order.index(cell["object"]) for cell in own]
        colour = COLOURS[number % len(COLOURS)]
        axes.scatter([100 * cell["clear_of_table"] for cell in own], places, s=28, color=colour, label=hand, zorder=3)
    axes.set_yticks(range(len(order)) if named else [], order if named else [], fontsize=8)
    axes.set_xlim(-0.02 * axes.get_xlim()[1], None)
    axes.set_xlabel("% of the valid grasps that are clear in at least one scene", fontsize=9)
    plain_axes(axes, grid_below=True)
    figure.legend(loc="outside upper right", ncols=8, frameon=False)
    return figure


def _plot_joints(card: Row, tally: Tally) -> Any:
    hands = [hand for hand in _names(card, "hands") if card["joints"].get(hand)][:_PANELS]
    if not hands:
        return None
    most = max(len(card["joints"][hand]) for hand in hands)
    figure = new_figure(max(5.0, 3.4 * len(hands)), 0.9 + 0.21 * most)
    panels = figure.subplots(1, len(hands), squeeze=False)[0]
    for number, (axes, hand) in enumerate(zip(panels, hands, strict=True)):
        joints = card["joints"][hand]
        colour = COLOURS[_names(card, "hands").index(hand) % len(COLOURS)]
        for row, use in enumerate(joints.values()):
            axes.plot([0, 1], [row, row], color="#e2e8f0", linewidth=5, solid_capstyle="butt")
            axes.plot([use["p5"], use["p95"]], [row, row], color=colour, linewidth=5, solid_capstyle="butt")
            axes.plot(use["median"], row, marker="|", color="white", markersize=8, markeredgewidth=2)
        axes.set_yticks(range(len(joints)), joints, fontsize=7)
        axes.set_ylim(most - 0.4, -0.6)
        axes.set_xticks([0, 1], ["lower", "upper"], fontsize=8)
        axes.set_title(hand, fontsize=10)
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0)
        if number == 0:
            axes.set_xlabel("90 % of the grasps, with the median", fontsize=8)
    return figure


def _plot_sizes(card: Row, tally: Tally) -> Any:
    sizes = {obj["name"]: sorted(obj["extents_m"]) for obj in card["composition"]["objects"] if obj["extents_m"]}
    rows = [cell for cell in card["cells"] if cell["object"] in sizes and cell["of_validated"] is not None]
    if not rows:
        return None
    figure = new_figure(9, 3.2)
    panels = figure.subplots(1, 3, sharey=True)
    for axes, place, what in zip(panels, range(3), ("smallest", "middle", "largest"), strict=True):
        for number, hand in enumerate(_names(card, "hands")):
            own = [cell for cell in rows if cell["hand"] == hand]
            extents = [1e3 * sizes[cell["object"]][place] for cell in own]
            shares = [100 * cell["of_validated"] for cell in own]
            axes.scatter(extents, shares, s=22, color=COLOURS[number % len(COLOURS)], label=hand, alpha=0.85)
        axes.set_xlabel(f"{what} extent of the object, mm", fontsize=9)
        axes.tick_params(labelsize=8)
        axes.set(xlim=(0, None), ylim=(0, 103))
        plain_axes(axes, grid_below=True)
    panels[0].set_ylabel("valid share of validated grasps, %", fontsize=9)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=8, frameon=False)
    return figure
