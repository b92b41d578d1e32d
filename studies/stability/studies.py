"""Stability studies by name, full or quick; and the baselines on difficult shapes."""

from collections.abc import Callable, Sequence
from itertools import product
from typing import Final

from graspd.service.model.studies import StabilityMap, mark_reachable
from graspd.studies.stability import assets
from graspd.studies.stability.assets import BOUNDS, FAMILIES, MEASURE, SHOWS, MapOptions, shape_cell
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel


def run_studies(
    names: Sequence[str], hand: str, *, quick: bool, work: ExecutionContext, say: Callable[[str], None]
) -> list[StabilityMap]:
    """Return the maps of the named studies; `say` receives a line per cell."""
    model = hand_from_path(hand)
    options = MapOptions(4 if quick else 8, "draft" if quick else "standard", work, say)
    studies: dict[str, Callable[[], StabilityMap]] = {
        "shapes": lambda: assets.shape_map(
            model,
            options,
            fidelities=("draft",) if quick else ("draft", "standard", "fine"),
            families=("plate", "cube") if quick else tuple(assets.FAMILIES),
            # Grasps on an open mesh cost more than the rest of a quick run.
            defects=assets.CLOSED if quick else tuple(assets.DEFECTS),
        ),
        "hands": lambda: assets.hand_map(
            options,
            fingers=(1, 3) if quick else assets.FINGERS,
            sizes=() if quick else assets.SIZES,
            ratios=() if quick else assets.RATIOS,
            couplings=("each joint",) if quick else assets.COUPLINGS,
        ),
        "baselines": lambda: baseline_map(
            model, options, methods=METHODS[:2] if quick else METHODS, shapes={"cube": (60,)} if quick else SHAPES
        ),
    }
    found = []
    for name in names:
        say(f"study {name}")
        found.append(studies[name]())
    return found


#: Methods that plan around a free object; the first is graspd's own, the others are baselines.
METHODS: Final = ("fast_graspd", "autograsp", "dfc", "graspit", "graspd2022")
#: Parameters of each family of shapes: an easy one and difficult ones.
SHAPES: Final[dict[str, tuple[float, ...]]] = {
    "plate": (1, 10),
    "wedge": (10, 80),
    "ring": (8, 64),
    "cross": (20,),
    "cube": (10, 30, 60, 100, 200),
}


def baseline_map(
    hand: HandModel, options: MapOptions, *, methods: Sequence[str], shapes: dict[str, tuple[float, ...]]
) -> StabilityMap:
    cells = []
    for family, values in shapes.items():
        unit, make, _ = FAMILIES[family]
        for value, method in product(values, methods):
            cell = shape_cell(hand, (f"{family}: {unit}", value, method), make(value), options, method=method)
            options.say(f"{family} {value:g} {method}: {cell.outcome} {cell.value:.2f} {cell.note}")
            cells.append(cell)
    return StabilityMap(
        "baselines",
        f"{options.count} grasps of {hand.name} by each method on difficult shapes",
        "the shape's parameter",
        "method",
        MEASURE,
        BOUNDS,
        mark_reachable(cells, lambda cell: True),
        SHOWS,
        "gate and validator reject bad grasps; a job with too few valid grasps reports it",
        "tests/studies/test_stability.py::test_a_job_whose_every_grasp_is_bad_ends_with_none",
        reach="all: a job may use any method",
    )
