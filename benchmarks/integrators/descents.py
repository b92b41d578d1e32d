"""Stress tests of the planner's descent.

They use displaced starts, extreme rates and weights, and up to 100,000 iterations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Final

import numpy as np

from benchmarks.integrators.grades import grade
from graspd.service.model.fidelity import FIDELITIES, Fidelity
from graspd.service.model.studies import MapCell, StabilityMap, format_short, mark_reachable
from graspd.service.model.transforms import Floats, quat_rotate
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.candidates import merits
from graspd.worker.planners.fast_graspd.pairs import Pair, pair_of
from graspd.worker.planners.fast_graspd.schedule import AROUND, coarse_schedule, fine_schedule
from graspd.worker.planners.fast_graspd.starts import sample_starts
from graspd.worker.simulation.data import Data, HandState, Schedule
from graspd.worker.simulation.projection import Projection
from graspd.worker.simulation.record import record_iteration

Say = Callable[[str], None]

#: Displacements of the start along the approach [m]: positive towards the object, negative away from it.
MOVES_M: Final = (-0.5, -0.2, -0.1, -0.05, 0.0, 0.03, 0.06, 0.1)
#: Factors on the optimiser's rates, and on the penetration weights.
RATES: Final = (0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0)
WEIGHTS: Final = (0.0, 0.01, 0.1, 1.0, 10.0, 100.0)
#: Names of the panels. Plain descent uses the rates tuned for Adam, unlike `optimizer: gd`.
_OPTIMIZERS: Final = {"adam": "Adam", "gd": "plain descent, Adam's rates"}
LENGTHS: Final = (100, 1_000, 10_000, 100_000)
DEPTH_MM: Final = (0.5, 2.0)  # median penetration that counts as weak and as broken [mm]
#: Residual of the contact force balance that counts as weak and as broken; 1: no balance.
RESIDUAL: Final = (0.35, 0.9)


@dataclass(frozen=True)
class DescentResult:
    state: HandState
    depths: Floats  # (n,) deepest penetration after the projection, as in a job [m]
    drift: float  # largest deviation of a quaternion's norm from 1, before the projection normalises it


def descend(
    pair: Pair,
    state: HandState,
    fidelity: Fidelity,
    *,
    rates: float = 1.0,
    weights: float = 1.0,
    iterations: int | None = None,
    optimizer: str = "adam",
) -> DescentResult:
    """Run coarse phase, fine phase and projection from the hands `state`.
    `rates` and `weights` are factors on the optimiser's rates and on the weights of penetration. `iterations` is the
    length of the fine phase; beyond the fidelity's, the schedule's last row is repeated."""
    n = len(state.pivot)
    for side, schedule in ((pair.coarse, coarse_schedule(fidelity)), (pair.fine, fine_schedule(fidelity))):
        model = pair.model(side)
        data = Data(model, n)
        scaled = replace(
            schedule,
            rates=rates * schedule.rates,
            penetration=weights * schedule.penetration,
            object_penetration=weights * schedule.object_penetration,
        )
        steps = len(schedule) if side is pair.coarse or iterations is None else iterations
        data.set_schedule(_lengthen_schedule(scaled, steps))
        data.set_state(state)
        record_iteration(model, data, optimizer).run(steps)
        state = data.state(n)
    drift = float(np.abs(np.linalg.norm(state.rotation, axis=1) - 1.0).max())
    state, depths = Projection(model, data, AROUND).run(state, fidelity.polish_iterations)
    return DescentResult(state, depths, drift)


def start_map(hand: HandModel, obj: ObjectModel, *, count: int, say: Say) -> StabilityMap:
    fidelity = FIDELITIES["standard"]
    pair = pair_of(hand, obj, fidelity, "cpu")
    state = starts_of(pair, count)
    along = quat_rotate(state.rotation, hand.palm.approach)
    cells = []
    for move in MOVES_M:
        moved = replace(state, pivot=state.pivot + move * along)
        cells += _cells(pair, descend(pair, moved, fidelity), f"{hand.name} on {obj.name}", move, "standard")
        say(f"start moved by {move * 1e3:.0f} mm: {cells[-1].outcome}")
    return StabilityMap(
        "starts",
        f"{count} starts moved along the approach",
        "displacement towards the object [m]",
        "fidelity",
        _MEASURE,
        _BOUNDS,
        mark_reachable(cells, lambda cell: cell.x == 0.0),
        "a hand that stays away has no contacts; a hand that starts inside the object stays there",
        "starts of the planner are free of contact; the merit rejects hands without balance, the gate penetration",
        "tests/studies/test_stability.py::test_a_start_that_is_too_far_is_flagged",
        reach="only 0 m, because the planner draws the starts",
    )


def rate_map(
    hand: HandModel, obj: ObjectModel, *, rates: Sequence[float], weights: Sequence[float], count: int, say: Say
) -> StabilityMap:
    fidelity = FIDELITIES["draft"]
    pair = pair_of(hand, obj, fidelity, "cpu")
    state = starts_of(pair, count)
    cells = []
    for optimizer, rate in product(_OPTIMIZERS, rates):
        for weight in weights:
            found = descend(pair, state, fidelity, rates=rate, weights=weight, optimizer=optimizer)
            cells += _cells(pair, found, _OPTIMIZERS[optimizer], rate, weight)
        say(f"{optimizer} rate x {rate:g}: {[cell.outcome for cell in cells[-len(weights) :]]}")
    return StabilityMap(
        "rates",
        f"Rates and weights of the descent, draft, {hand.name} on {obj.name}",
        "factor on the rates",
        "factor on the weights of penetration",
        _MEASURE,
        _BOUNDS,
        mark_reachable(cells, lambda cell: (cell.panel, cell.x, cell.y) == (_OPTIMIZERS["adam"], 1.0, 1.0)),
        "hands jump past the object or penetrate it",
        "the schedule fixes rates and weights; hands with numbers that are not finite are rejected, others validated",
        "tests/worker/test_certified.py::test_hands_that_are_no_numbers_are_dropped_and_counted",
        reach="Adam with factors 1: rates and weights are no options of a job; `optimizer: gd` uses those of the paper",
    )


def length_map(hand: HandModel, obj: ObjectModel, *, lengths: Sequence[int], say: Say) -> StabilityMap:
    fidelity = FIDELITIES["draft"]
    pair = pair_of(hand, obj, fidelity, "cpu")
    state = starts_of(pair, 4)
    cells = []
    for length in lengths:
        found = descend(pair, state, fidelity, iterations=length)
        (cell,) = _cells(pair, found, "draft", length, "residual")
        cells += [cell, MapCell("draft", length, "quaternion drift", found.drift, grade(found.drift, 1e-5, 1e-3))]
        say(f"{length} iterations: {cell.outcome}, quaternions off by {found.drift:.1e}")
    return StabilityMap(
        "length",
        f"Long runs of the fine phase, {hand.name} on {obj.name}",
        "iterations",
        "measure",
        _MEASURE + "; drift: largest deviation of a quaternion's norm from 1",
        _BOUNDS + "; drift: 1e-5, 1e-3",
        mark_reachable(cells, lambda cell: True),
        "rotations of poses become invalid, or hands drift away",
        "quaternions are normalised in each step; a grasp that does not improve stops after `patience` iterations",
        "tests/studies/test_stability.py::test_a_long_run_does_not_drift",
        reach="all: a custom fidelity may have 100,000 iterations",
    )


_ORDER: Final = ("good", "weak", "broken")
_MEASURE: Final = "median residual of balanced contact forces (1: no balance); ↓ median penetration [mm], if worse"
_BOUNDS: Final = (
    f"weak: residual {RESIDUAL[0]:g} or {DEPTH_MM[0]:g} mm deep; "
    f"broken: {RESIDUAL[1]:g}, {DEPTH_MM[1]:g} mm, or a value that is not finite"
)


def starts_of(pair: Pair, count: int) -> HandState:
    return sample_starts(pair.model(pair.coarse), seed=11, batch=0, indices=range(count), each=1)


def _cells(pair: Pair, found: DescentResult, panel: str, x: float | str, y: float | str) -> list[MapCell]:
    state = found.state
    finite = bool(np.isfinite(state.pivot).all() and np.isfinite(state.q).all() and np.isfinite(state.rotation).all())
    if not finite:
        return [MapCell(panel, x, y, float("nan"), "broken", "values are not finite")]
    residual = float(np.median(merits(pair.hand.model, pair.fine.obj.model, state, np.zeros(len(found.depths)))))
    depth = float(np.median(found.depths)) * 1e3
    held, deep = grade(residual, *RESIDUAL), grade(depth, *DEPTH_MM)
    is_deep = _ORDER.index(deep) > _ORDER.index(held)
    # The label shows the cause of a bad cell.
    label = f"↓{format_short(depth)}" if is_deep else ""
    said = f"residual {residual:.2g}, {depth:.2g} mm deep"
    return [MapCell(panel, x, y, residual, deep if is_deep else held, said, label)]


def _lengthen_schedule(schedule: Schedule, iterations: int) -> Schedule:
    """Return the schedule with its last row repeated."""
    rows = np.minimum(np.arange(max(iterations, len(schedule))), len(schedule) - 1)
    return replace(schedule, **{field.name: getattr(schedule, field.name)[rows] for field in fields(schedule)})
