"""Model errors: grasps that hold in the validator's model are tested in models with a single error.

Amounts of error range from those of `--robust` (`worker.validation.variant`) to amounts at which few grasps hold.
Displacements and rotations of each grasp have their own direction."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.domain import JobRequest
from graspd.service.model.studies import MapCell, Outcome, StabilityMap
from graspd.studies.stability.shapes import MapOptions
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import MujocoOptions
from graspd.worker.validation.variant import (
    ARMATURE,
    CENTRE_M,
    DRY_FRICTION,
    FACTOR,
    FRICTIONS,
    GROWTH_M,
    LATEST,
    SHIFT_M,
    TURN,
    Models,
    Variant,
    Vector,
)

Direction = NDArray[np.float64]
Make = Callable[[HandModel, float, Direction], Variant]

#: Shares of grasps below which a cell counts as weak and as broken.
WEAK: Final = 0.75
BROKEN: Final = 0.25
_MM: Final = 1e-3
_ROUNDING: Final = 1e-9


@dataclass(frozen=True)
class _Error:
    amounts: tuple[float, ...]
    drawn: tuple[float, float]  # least and largest amount in `--robust`
    variant: Make


def _scaled_direction(direction: Direction, length: float) -> Vector:
    x, y, z = (length * direction).tolist()
    return x, y, z


def _finger_lags(hand: HandModel, latest: float) -> tuple[float, ...]:
    fingers = len(hand.fingertips)
    return tuple((latest * np.arange(fingers) / max(1, fingers - 1)).tolist())


ERRORS: Final[dict[str, _Error]] = {
    "collision shapes of the hand grown by [mm]": _Error(
        (-4, -2, -1, -0.5, 0.5, 1, 2, 4), (-GROWTH_M / _MM, GROWTH_M / _MM), lambda h, x, d: Variant(grown_m=x * _MM)
    ),
    "friction, relative to the model": _Error(
        (0.25, 0.5, 0.67, 0.8, 1.33, 2), FRICTIONS, lambda h, x, d: Variant(friction=x)
    ),
    "mass, relative to the model": _Error((0.25, 0.5, 2, 4, 8), (1 / FACTOR, FACTOR), lambda h, x, d: Variant(mass=x)),
    "gains, relative to the model": _Error(
        (0.12, 0.25, 0.5, 2, 4, 8), (1 / FACTOR, FACTOR), lambda h, x, d: Variant(gain=x)
    ),
    "armature [1e-4 kg m²]": _Error(
        (1, 2, 4, 16, 64), (0.0, 1e4 * ARMATURE * FACTOR), lambda h, x, d: Variant(armature=1e-4 * x)
    ),
    "dry friction of joints [N m]": _Error(
        (0.005, 0.01, 0.02, 0.05, 0.1, 0.2), (0.0, DRY_FRICTION * FACTOR), lambda h, x, d: Variant(dry_friction=x)
    ),
    "object displaced by [mm]": _Error(
        (1, 2, 4, 8, 16), (0.0, SHIFT_M / _MM), lambda h, x, d: Variant(object_shift_m=_scaled_direction(d, x * _MM))
    ),
    "object rotated by [°]": _Error(
        (1, 2, 5, 10, 20),
        (0.0, float(np.degrees(TURN))),
        lambda h, x, d: Variant(object_turn=_scaled_direction(d, float(np.radians(x)))),
    ),
    "hand displaced by [mm]": _Error(
        (1, 2, 4, 8, 16), (0.0, SHIFT_M / _MM), lambda h, x, d: Variant(hand_shift_m=_scaled_direction(d, x * _MM))
    ),
    "centre of mass displaced by [mm]": _Error(
        (2, 5, 10, 20, 40), (0.0, CENTRE_M / _MM), lambda h, x, d: Variant(centre_m=_scaled_direction(d, x * _MM))
    ),
    "last finger delayed by [share of closing]": _Error(
        (0.1, 0.25, 0.5, 0.75), (0.0, LATEST), lambda h, x, d: Variant(lags=_finger_lags(h, x))
    ),
}


def model_error_map(
    hands: Sequence[HandModel], obj: ObjectModel, options: MapOptions, *, errors: Sequence[str] = (), every: int
) -> StabilityMap:
    """Map the share of valid grasps that hold despite an error of the model.
    `errors` are names of errors (default: all); each `every`-th amount is tested."""
    cells = [cell for hand in hands for cell in _cells(hand, obj, options, errors or tuple(ERRORS), every)]
    return StabilityMap(
        "model_errors",
        f"{options.count} valid grasps of {obj.name}, validated in models with errors",
        "amount of the error",
        "hand",
        "share of grasps that also hold in this model",
        f"weak: under {WEAK:g}; broken: under {BROKEN:g}",
        cells,
        "a valid grasp fails on a robot that differs from the model",
        "`--robust` selects grasps that hold in the wanted share of models with such errors; `robust_share` and "
        "`robust_weakest` are stored. For larger errors, test another hand model: `python -m benchmarks.second_hand`",
        "tests/studies/test_stability.py::test_amounts_within_reach_are_those_that_robust_draws",
        reach="errors within the range of `--robust`",
    )


def _cells(hand: HandModel, obj: ObjectModel, options: MapOptions, errors: Sequence[str], every: int) -> list[MapCell]:
    count, run = options.count, options.run
    request = JobRequest(hand="hand", object="object", grasps=count, fidelity=options.fidelity, rechecks=0)
    grasps = validated_grasps(hand, obj, request, count=count, run=run).grasps
    models = Models(hand, obj, decompose(obj), MujocoOptions())
    ways = np.random.default_rng(11).normal(size=(count, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)

    def share(error: _Error, amount: float) -> float:
        with ThreadPoolExecutor(run.cores, thread_name_prefix="model-errors") as pool:
            validated = pool.map(
                lambda row: models.standard(grasps, row, error.variant(hand, amount, ways[row])).success,
                range(len(grasps)),
            )
            return float(np.mean(list(validated))) if len(grasps) else float("nan")

    cells = []
    for name in errors:
        error = ERRORS[name]
        low, high = error.drawn
        for amount in error.amounts[every - 1 :: every]:
            held = share(error, amount)
            outcome: Outcome = "good" if held >= WEAK else "weak" if held >= BROKEN else "broken"
            cell = MapCell(name, amount, hand.name, held, outcome, f"{held:.0%} of {len(grasps)} hold")
            cells.append(replace(cell, reached=low - _ROUNDING <= amount <= high + _ROUNDING))
            options.say(f"{hand.name}: {name} {amount:g}: {cell.outcome} {cell.note}")
    return cells
