"""One cell of the chart: a method at a fidelity on a hand and an object, run several times and validated."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.fidelity import Fidelity
from graspd.service.model.transforms import Floats
from graspd.studies.clock import clock_of
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners import PlanRequest, synthesize
from graspd.worker.planners import Rollout as Tried
from graspd.worker.quality.gate import passes
from graspd.worker.quality.table import measure
from graspd.worker.scenes.rollout import rollout_on
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.displacement import simulated_displacement_cm
from graspd.worker.validation.robust import robust
from graspd.worker.validation.validator import validate

#: Contact threshold and Coulomb coefficient of area, epsilon and wrench volume: the paper's.
THRESHOLD_M: Final = 0.005
FRICTION: Final = 1.0
#: A seed no setting was chosen with; repeats take the next ones.
SEED: Final = 4711
WARM_SEED: Final = 1
#: Of the models around the nominal one: no job's, nor that of `graspd evaluate`.
MODELS_SEED: Final = 2**31 + 1
#: Grasps per object in the paper's table 2: the best by epsilon.
BEST: Final = 10
#: Columns kept of every grasp.
COLUMNS: Final = {
    "epsilon": "epsilon",
    "pd_mm": "penetration_depth_mm",
    "spd_mm": "self_penetration_depth_mm",
    "ca_cm2": "contact_area_cm2",
    "iv_cm3": "intersection_volume_cm3",
    "wrench_volume": "wrench_volume",
}


Make = Callable[[HandModel, ObjectModel, int, int], GraspSet]
"""From hand, object, grasps and seed to grasps."""


@dataclass(frozen=True)
class Setting:
    """What is compared: a method with its options at a fidelity."""

    method: str
    fidelity: str
    """Its label."""
    knobs: Fidelity
    options: Mapping[str, Any] = field(default_factory=dict)
    batch: int = 32
    """Grasps per call, and per repeat."""
    warm: Mapping[str, Any] = field(default_factory=dict)
    """Options of the call before the first timed one."""
    run: ExecutionContext = DEFAULT_CONTEXT
    make: Make | None = None
    """Another way to make them than by method and fidelity: for sweeps of what no fidelity names."""

    def grasps(
        self,
        hand: HandModel,
        obj: ObjectModel,
        count: int,
        seed: int,
        *,
        rollout: Tried | None = None,
        warm: bool = False,
    ) -> GraspSet:
        """Make grasps; methods that try candidates do so by `trial`."""
        if self.make is not None:
            return self.make(hand, obj, count, seed)
        options = {**self.options, **(self.warm if warm else {})}
        wanted = PlanRequest(count, self.knobs, seed, rollout=rollout)
        return synthesize(hand, obj, wanted, self.run, method=self.method, options=options)


@dataclass
class Rollout:
    """Repeats of a setting on a pair, as they come in."""

    setting: Setting
    hand: HandModel
    obj: ObjectModel
    """As the planner sees it."""
    true: ObjectModel
    """As metrics and validator see it: the same for all settings."""
    pieces: ConvexPieces
    """Of `true`."""
    seconds: list[float] = field(default_factory=list)
    """On a CPU those of all threads together, which do not ask what else the machine does; on a GPU those that pass."""
    end_seconds: list[float] = field(default_factory=list)
    """End to end: planned, validated, and measured where they hold."""
    made: list[GraspSet] = field(default_factory=list)
    success: list[NDArray[np.int8]] = field(default_factory=list)
    """Verdicts of the standard level."""
    kept: list[NDArray[np.int8]] = field(default_factory=list)
    """1 valid: a grasp holds and is feasible."""
    columns: list[dict[str, Floats]] = field(default_factory=list)
    first_calls: list[float] = field(default_factory=list)
    """Seconds of calls of `first_grasps` grasps, end to end."""
    first_grasps: int = 1
    dexgraspbench: list[NDArray[np.int8]] = field(default_factory=list)
    """Verdicts of the unmodified DexGraspBench protocol; with `hard` and `shares` there only after `scrutinise`."""
    hard: list[NDArray[np.int8]] = field(default_factory=list)
    shares: list[Floats] = field(default_factory=list)
    """Of other models in which a grasp holds; nan where it does not in the nominal one."""

    @cached_property
    def tried(self) -> Tried | None:
        """What candidates go through, as where grasps are made for users."""
        return rollout_on(self.setting.run, self.hand, self.obj, self._pieces, in_scenes=False)

    def _pieces(self) -> ConvexPieces:
        return self.pieces

    @property
    def _clock(self) -> Callable[[], float]:
        return clock_of(self.setting.run.device)

    def warm_up(self) -> None:
        """One call that is not counted: kernels, grids and samples are there afterwards."""
        self.setting.grasps(self.hand, self.obj, 1, WARM_SEED, rollout=self.tried, warm=True)

    def repeat(self) -> None:
        """One timed call, then quality and verdict of its grasps."""
        batch = self.setting.batch
        began = self._clock()
        found = self.setting.grasps(self.hand, self.obj, batch, SEED + len(self.seconds), rollout=self.tried)
        self.seconds.append(self._clock() - began)
        success, feasible, table = self._finished(found)
        self.end_seconds.append(self._clock() - began)
        lost = self._measured(found.take(np.flatnonzero(success != 1)))
        self.made.append(found)
        self.success.append(success)
        self.kept.append(feasible)
        columns = {}
        for key in COLUMNS:
            columns[key] = np.empty(len(found))
            columns[key][success == 1], columns[key][success != 1] = table[key], lost[key]
        self.columns.append(columns)

    def _finished(self, found: GraspSet) -> tuple[NDArray[np.int8], NDArray[np.int8], dict[str, Floats]]:
        """What a job does with planned grasps: verdicts, which are valid, and the columns of those that hold."""
        success = validate(self.hand, self.true, found, pieces=self.pieces, run=self.setting.run).success
        held = np.flatnonzero(success == 1)
        table = self._measured(found.take(held))
        kept = np.zeros(len(found), np.int8)
        kept[held] = table.pop("feasible")
        return success, kept, table

    def _measured(self, found: GraspSet) -> dict[str, Floats]:
        table = measure(
            self.hand, self.true, found, friction=FRICTION, thresholds_m=[THRESHOLD_M], run=self.setting.run
        )
        columns = {key: _flat(table[f"quality/{name}"]) for key, name in COLUMNS.items()}
        return columns | {"feasible": np.asarray(passes(table), float)}

    def scrutinise(self, models: int) -> None:
        """Validate what was made under the DexGraspBench protocol, at half the friction, and in so many models around
        the nominal one."""
        common: dict[str, Any] = {"pieces": self.pieces, "run": self.setting.run}
        for found, success in zip(self.made, self.success, strict=True):
            self.dexgraspbench.append(validate(self.hand, self.true, found, level="dexgraspbench", **common).success)
            self.hard.append(validate(self.hand, self.true, found, hard=True, **common).success)
            shares = robust(self.hand, self.true, found, held=success, models=models, seed=MODELS_SEED, **common).share
            self.shares.append(shares)

    def time_first(self, grasps: int) -> None:
        """Time a call of few grasps, as somebody would make who waits for the first valid one.

        Where a grasp takes longer than a second the time follows from the batch.
        """
        self.first_grasps = grasps
        each = self.end_seconds[-1] / self.setting.batch
        if each > 1.0:
            self.first_calls.append(each * grasps)
            return
        began = self._clock()
        self._finished(self.setting.grasps(self.hand, self.obj, grasps, SEED - len(self.seconds), rollout=self.tried))
        self.first_calls.append(self._clock() - began)

    def values(self, key: str) -> Floats:
        """A column of all repeats."""
        return np.concatenate([columns[key] for columns in self.columns])

    def best(self) -> dict[str, float]:
        """Means over the `BEST` grasps by epsilon, with their simulated displacement: a row of the paper's table 2."""
        order = np.argsort(-self.values("epsilon"), kind="stable")[:BEST]
        pose, joints = (
            np.concatenate([getattr(found.grasp, name) for found in self.made])[order]
            for name in ("hand_pose", "joint_positions")
        )
        slip = simulated_displacement_cm(
            self.hand, self.true, Posture(pose, joints), pieces=self.pieces, run=self.setting.run
        )
        names = ("ca_cm2", "iv_cm3", "epsilon", "wrench_volume")
        row = {name: float(np.nanmean(self.values(name)[order])) for name in names}
        return row | {"sd_cm": float(slip.mean()), "n": float(len(order))}


def _flat(values: NDArray[Any]) -> Floats:
    return np.asarray(values, float).reshape(len(values))
