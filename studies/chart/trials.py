"""Settings of a chart, and their repeated, validated runs on a hand and an object."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.fidelity import Fidelity
from graspd.service.model.transforms import Floats
from graspd.studies.bench import clock_of
from graspd.studies.evaluation import COLUMNS, THRESHOLD_M
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners import PlanRequest, synthesize
from graspd.worker.planners import Rollout as Tried
from graspd.worker.quality.gate import passes_gate
from graspd.worker.quality.table import measure
from graspd.worker.scenes.rollout import create_rollout
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.displacement import simulated_displacement_cm
from graspd.worker.validation.robust import validate_robustness
from graspd.worker.validation.validator import validate

FRICTION: Final = 1.0  # Coulomb coefficient for epsilon and wrench volume: the paper's
#: First seed, not used for tuning of any setting; repeats use the following seeds.
SEED: Final = 4711
WARM_SEED: Final = 1
#: Seed of the models around the nominal one; neither jobs nor `graspd evaluate` use it.
MODELS_SEED: Final = 2**31 + 1
BEST: Final = 10  # number of best grasps by epsilon per pair, as in table 2 of the paper


@dataclass(frozen=True)
class Setting:
    """A compared setting: a method with its options at a fidelity."""

    method: str
    fidelity: str  # label of the fidelity
    knobs: Fidelity
    options: Mapping[str, Any] = field(default_factory=dict)
    batch: int = 32  # number of grasps per call; a call is one repeat
    warm: Mapping[str, Any] = field(default_factory=dict)  # options of the call before the first timed one
    run: ExecutionContext = DEFAULT_CONTEXT

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
        """Plan grasps; methods with rollouts use `rollout`."""
        options = {**self.options, **(self.warm if warm else {})}
        wanted = PlanRequest(count, self.knobs, seed, rollout=rollout)
        return synthesize(hand, obj, wanted, self.run, method=self.method, options=options)


@dataclass
class SettingRuns:
    """Accumulated repeats of a setting on a pair."""

    setting: Setting
    hand: HandModel
    obj: ObjectModel  # object for the planner
    true: ObjectModel  # object for metrics and validator, the same for all settings
    pieces: ConvexPieces  # convex pieces of `true`
    seconds: list[float] = field(default_factory=list)
    """Core-seconds of all threads on a CPU, independent of other load; wall-clock seconds on a GPU."""
    end_seconds: list[float] = field(default_factory=list)
    """Seconds end to end: planning, validation, and metrics of held grasps."""
    made: list[GraspSet] = field(default_factory=list)
    success: list[NDArray[np.int8]] = field(default_factory=list)  # verdicts of the standard level
    kept: list[NDArray[np.int8]] = field(default_factory=list)  # 1 if valid, that is, held and feasible
    columns: list[dict[str, Floats]] = field(default_factory=list)
    first_calls: list[float] = field(default_factory=list)
    """Seconds of calls with `first_grasps` grasps, end to end."""
    first_grasps: int = 1
    dexgraspbench: list[NDArray[np.int8]] = field(default_factory=list)
    """Verdicts of the unmodified DexGraspBench protocol; `validate_strictly` sets these, `hard` and `shares`."""
    hard: list[NDArray[np.int8]] = field(default_factory=list)
    shares: list[Floats] = field(default_factory=list)
    """Share of other models in which a grasp holds; nan if it does not hold in the nominal one."""

    @cached_property
    def planner_rollout(self) -> Tried | None:
        """Rollouts of candidates, as in jobs."""
        return create_rollout(self.setting.run, self.hand, self.obj, lambda: self.pieces, in_scenes=False)

    @property
    def _clock(self) -> Callable[[], float]:
        return clock_of(self.setting.run.device)

    def warm_up(self) -> None:
        """Make one untimed call to prepare kernels, grids and samples."""
        self.setting.grasps(self.hand, self.obj, 1, WARM_SEED, rollout=self.planner_rollout, warm=True)

    def repeat(self) -> None:
        """Make one timed call, then measure and validate its grasps."""
        batch = self.setting.batch
        began = self._clock()
        found = self.setting.grasps(self.hand, self.obj, batch, SEED + len(self.seconds), rollout=self.planner_rollout)
        self.seconds.append(self._clock() - began)
        success, feasible, table = self._validate_and_measure(found)
        self.end_seconds.append(self._clock() - began)
        lost = self._measure(found.take(np.flatnonzero(success != 1)))
        self.made.append(found)
        self.success.append(success)
        self.kept.append(feasible)
        columns = {}
        for key in COLUMNS:
            columns[key] = np.empty(len(found))
            columns[key][success == 1], columns[key][success != 1] = table[key], lost[key]
        self.columns.append(columns)

    def _validate_and_measure(self, found: GraspSet) -> tuple[NDArray[np.int8], NDArray[np.int8], dict[str, Floats]]:
        """Return verdicts (N,), valid flags (N,), and metrics of held grasps, as in a job."""
        success = validate(self.hand, self.true, found, pieces=self.pieces, run=self.setting.run).success
        held = np.flatnonzero(success == 1)
        table = self._measure(found.take(held))
        kept = np.zeros(len(found), np.int8)
        kept[held] = table.pop("feasible")
        return success, kept, table

    def _measure(self, found: GraspSet) -> dict[str, Floats]:
        table = measure(
            self.hand, self.true, found, friction=FRICTION, thresholds_m=[THRESHOLD_M], run=self.setting.run
        )
        columns = {key: np.asarray(table[f"quality/{name}"], float).reshape(-1) for key, name in COLUMNS.items()}
        return columns | {"feasible": np.asarray(passes_gate(table), float)}

    def validate_strictly(self, models: int) -> None:
        """Validate by DexGraspBench's protocol, at half the friction, and in models around the nominal one."""
        common: dict[str, Any] = {"pieces": self.pieces, "run": self.setting.run}
        for found, success in zip(self.made, self.success, strict=True):
            self.dexgraspbench.append(validate(self.hand, self.true, found, level="dexgraspbench", **common).success)
            self.hard.append(validate(self.hand, self.true, found, hard=True, **common).success)
            shares = validate_robustness(
                self.hand, self.true, found, held=success, models=models, seed=MODELS_SEED, **common
            ).share
            self.shares.append(shares)

    def time_first(self, grasps: int) -> None:
        """Time a call of this many grasps; above 1 s per grasp, scale the time of the last batch instead."""
        self.first_grasps = grasps
        each = self.end_seconds[-1] / self.setting.batch
        if each > 1.0:
            self.first_calls.append(each * grasps)
            return
        began = self._clock()
        self._validate_and_measure(
            self.setting.grasps(self.hand, self.obj, grasps, SEED - len(self.seconds), rollout=self.planner_rollout)
        )
        self.first_calls.append(self._clock() - began)

    def values(self, key: str) -> Floats:
        return np.concatenate([columns[key] for columns in self.columns])

    def best(self) -> dict[str, float]:
        """Return a row of the paper's table 2: means over the `BEST` grasps by epsilon."""
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
