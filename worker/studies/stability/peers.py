"""What other methods do with shapes that are hard, beside graspd's own, through the same doors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from service.model.studies import StabilityMap, reachable
from worker.hands.model import HandModel
from worker.run import ALONE, Run
from worker.studies.stability.shapes import BOUNDS, FAMILIES, MEASURE, SHOWS, shape_cell

#: Methods around a free object; the first is graspd's own.
METHODS: Final = ("fast_graspd", "autograsp", "dfc", "graspit", "graspd2022")
#: Parameters of each family: an easy one and hard ones.
SHAPES: Final[dict[str, tuple[float, ...]]] = {
    "plate": (1, 10),
    "wedge": (10, 80),
    "ring": (8, 64),
    "cross": (20,),
    "cube": (10, 30, 60, 100, 200),
}


def peer_map(
    hand: HandModel,
    *,
    methods: Sequence[str] = METHODS,
    shapes: dict[str, tuple[float, ...]] = SHAPES,
    count: int = 8,
    run: Run = ALONE,
    say: Callable[[str], None] = lambda line: None,
) -> StabilityMap:
    """Valid grasps of each method on each shape, at the settings that it was published with."""
    cells = []
    for family, values in shapes.items():
        unit, make, _ = FAMILIES[family]
        for value in values:
            for method in methods:
                place = (f"{family}: {unit}", value, method)
                cell = shape_cell(hand, place, make(value), {"units": "m"}, {"method": method}, count, run)
                say(f"{family} {value:g} {method}: {cell.outcome} {cell.value:.2f} {cell.note}")
                cells.append(cell)
    return StabilityMap(
        "peers",
        f"{count} grasps of {hand.name} by each method on shapes that are hard",
        "the shape's parameter",
        "method",
        MEASURE,
        BOUNDS,
        reachable(cells, lambda cell: True),
        SHOWS,
        "what a method leaves in the object or the referee drops is never valid; a job that finds too few says so",
        "tests/worker/studies/test_stability.py::test_a_job_whose_every_grasp_is_bad_ends_with_none",
        reach="all: any job may name another method",
    )
