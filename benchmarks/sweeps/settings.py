"""One-at-a-time sweeps of fast_graspd's settings: loss of accuracy and gain in speed.

Some settings are not part of a fidelity: passes of the contact solver, culling by grid and band, and queries. The M
simulations share one closest-point query per hand point; the paper's code makes M queries."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import warp as wp

from benchmarks.sweeps import kernels
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import FIDELITIES, Fidelity
from graspd.studies.chart.chart import TRUE_ERROR_M, ChartObject
from graspd.studies.chart.statistics import rounded_json_value, run_figures
from graspd.studies.chart.trials import Setting, SettingRuns
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.pairs import Pair, pair_of
from graspd.worker.planners.fast_graspd.planner import grasps_of, optimise_pair
from graspd.worker.planners.port import PlanRequest
from graspd.worker.simulation import record
from graspd.worker.simulation.data import Data
from graspd.worker.simulation.launches import Launches
from graspd.worker.simulation.model import LossOptions, Model
from graspd.worker.validation.decomposition import decompose

Change = Callable[[Pair], Pair]
DEFAULT: Final = FIDELITIES["standard"]


@dataclass(frozen=True)
class KnobValue:
    knob: str
    value: str
    fidelity: Fidelity = DEFAULT
    change: Change | None = None

    @property
    def is_default(self) -> bool:
        return self.fidelity == DEFAULT and self.change is None


def _options(**changes: Any) -> Change:
    return lambda pair: replace(pair, options=replace(pair.options, **changes))


def knob_values(quick: bool = False, knobs: Sequence[str] = ()) -> list[KnobValue]:
    """Return the values of all settings, or of those in `knobs`, including defaults.
    With `quick`, return four values of two settings. Raises InputError: a name is not a setting."""

    def knob(name: str, between: str, **values: Sequence[Any]) -> list[KnobValue]:
        rows = zip(*values.values(), strict=True)
        return [
            KnobValue(name, between.join(map(str, row)), DEFAULT.model_copy(update=dict(zip(values, row, strict=True))))
            for row in rows
        ]

    found = knob("hand points", ", ", coarse_points=(64, 128, 256, 512), fine_points=(500, 1000, 2000, 4000))
    for error in (0, 1e-4, 3e-4, 1e-3, 3e-3):
        changed = DEFAULT.model_copy(update={"face_error_m": error})
        found.append(KnobValue("face error bound, mm", f"{1e3 * error:g}", changed))
    found += knob("iterations", " + ", coarse_iterations=(25, 50, 100, 200), fine_iterations=(10, 20, 40, 80))
    found += knob("starts, finalists", ", ", starts=(1, 2, 4, 8), finalists=(1, 1, 2, 4))
    found += knob("contact solver", "", contact_solver=("direct", "gauss_seidel"))
    for passes in (1, 2, 4, 8):
        change = None if passes == LossOptions().passes else _options(passes=passes)
        found.append(KnobValue("solver passes", str(passes), change=change))
    found += [KnobValue("queries", "shared"), KnobValue("queries", "one per velocity", change=query_per_velocity)]
    found += [
        KnobValue("culling", "grid and band"),
        KnobValue("culling", "band", change=_options(exact_below=1.0)),
        KnobValue("culling", "none", change=_options(exact_below=1.0, band=0.3)),
    ]
    known = list(dict.fromkeys(turn.knob for turn in found))
    if unknown := [name for name in knobs if name not in known]:
        raise InputError(f"there is no setting {unknown[0]!r}; choose from {', '.join(map(repr, known))}")
    if knobs:
        return [turn for turn in found if turn.knob in knobs]
    return [*found[:2], *(turn for turn in found if turn.knob == "queries")] if quick else found


@dataclass(frozen=True)
class TurnedSetting(Setting):
    """Setting of the chart that is planned by `plan_value`, because it may not be part of a fidelity."""

    turn: KnobValue = KnobValue("", "default")

    def grasps(self, hand: HandModel, obj: ObjectModel, count: int, seed: int, **_: Any) -> GraspSet:
        return plan_value(hand, obj, count, seed, turn=self.turn, run=self.run)


def sweep_settings(
    hand: HandModel,
    thing: ChartObject,
    *,
    batch: int,
    repeats: int,
    quick: bool,
    run: ExecutionContext,
    knobs: Sequence[str],
    say: Callable[[str], None],
) -> list[dict[str, Any]]:
    """Return a row per setting (`knob`) and value, with its `speedup` over the default.
    A row also has the figures of a run. Values are interleaved, repeat by repeat. Times are those of `clock_of`."""
    wp.load_module(module=kernels, device=run.device)
    default = KnobValue("", "default")
    true = thing.load(TRUE_ERROR_M)
    pieces = decompose(true)
    cells: dict[tuple[str, str], SettingRuns] = {}
    for turn in [default, *knob_values(quick, knobs)]:
        if turn is default or not turn.is_default:
            setting = TurnedSetting("fast_graspd", turn.value, turn.fidelity, batch=batch, run=run, turn=turn)
            cells[turn.knob, turn.value] = SettingRuns(
                setting, hand, thing.load(turn.fidelity.face_error_m), true, pieces
            )
    for _ in range(repeats):
        for cell in cells.values():
            # There are more settings than the device caches, so each is prepared just before it is timed.
            cell.warm_up()
            cell.repeat()
    base = run_figures(cells[default.knob, default.value])
    rows = []
    for turn in knob_values(quick, knobs):
        found = base if turn.is_default else run_figures(cells[turn.knob, turn.value])
        faster = found["grasps_per_second"] / base["grasps_per_second"]
        row = {
            "knob": turn.knob,
            "value": turn.value,
            "default": turn.is_default,
            "hand": hand.name,
            "object": thing.name,
        }
        rows.append(row | {"speedup": rounded_json_value(faster), **found})
        say(f"{turn.knob:22s} {turn.value:18s} x {faster:5.2f}  GSR {found['gsr']:.2f}  PD {found['pd_mm']:.2f} mm")
    return rows


def plan_value(
    hand: HandModel, obj: ObjectModel, count: int, seed: int, *, turn: KnobValue, run: ExecutionContext
) -> GraspSet:
    began = time.perf_counter()
    pair = pair_of(hand, obj, turn.fidelity, run.device)
    if turn.change is not None:
        pair = turn.change(pair)
    parts = optimise_pair(pair, PlanRequest(count, turn.fidelity, seed), run)
    return grasps_of(hand, obj, parts, time.perf_counter() - began)


class QueryPerVelocity(Pair):
    """Pair in which each simulated velocity makes its own distance queries; results are equal."""

    def iteration(self, model: Model, data: Data, optimizer: str, patience: int) -> Launches:
        out = Launches(model.device)
        record.add_poses(out, model, data)
        record.add_distances(out, model, data)
        for _ in range(model.options.velocities - 1):
            counts = [data.contacts.count, data.contacts.near_count]
            out.add(kernels.clear_contacts, data.capacity, inputs=[data.active], outputs=counts)
            record.add_distances(out, model, data)
        record.add_contact(out, model, data)
        record.add_penalties(out, model, data)
        record.add_gradient(out, model, data)
        record.add_step(out, model, data, optimizer, patience=patience)
        return out


def query_per_velocity(pair: Pair) -> Pair:
    return QueryPerVelocity(pair.coarse, pair.fine, pair.options, pair.hand)
