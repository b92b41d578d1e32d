"""Shared parts of the studies: subjects with grasps, CPU clock, rates with intervals, ranking power."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from graspd.service.model.fidelity import FIDELITIES
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.quality.intervals import wilson_interval
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.model import Scene
from graspd.worker.validation.protocol import Test

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Row = dict[str, Any]

#: Seed that was not used to choose any setting.
SEED = 9109
ALLEGRO = "hands/allegro/allegro_hand_right.urdf"
#: One descent per grasp, without selection: about half of the grasps hold, so predictors see both outcomes.
PLAIN = FIDELITIES["standard"].model_copy(update={"starts": 1, "finalists": 1})


@dataclass
class Spent:
    """CPU seconds of a block; they depend less on other load than wall time."""

    seconds: float = 0.0


@contextmanager
def cpu() -> Iterator[Spent]:
    """Measure the CPU time of a block over all threads of this process."""
    spent, began = Spent(), time.process_time()
    yield spent
    spent.seconds = time.process_time() - began


@dataclass
class Subject:
    """A hand, an object, and unselected grasps."""

    hand: HandModel
    obj: ObjectModel
    count: int

    @cached_property
    def grasps(self) -> GraspSet:
        return synthesize(
            self.hand, self.obj, PlanRequest(count=self.count, fidelity=PLAIN, seed=SEED), ExecutionContext(threads=1)
        )

    @cached_property
    def pieces(self) -> ConvexPieces:
        return decompose(self.obj)


def hand_of(data: Path | None) -> HandModel:
    return hand_from_path("allegro" if data is None else data / ALLEGRO)


def object_of(data: Path | None, name: str, face_error_m: float = FIDELITIES["standard"].face_error_m) -> ObjectModel:
    found = object_from_path(name if data is None else data / "objects" / name / "clean.stl", face_error_m=face_error_m)
    return replace(found, name=name)


def verdicts(scene: Scene, grasps: GraspSet) -> Bools:
    """Return (N,) whether each grasp holds at level standard in this scene; one thread."""
    test = Test(scene)
    return np.array([test.standard(grasps, row).success for row in range(len(grasps))], bool)


def share(good: int, total: int) -> Row:
    """Return a rate with its 95 % interval (Wilson)."""
    low, high = wilson_interval(int(good), total)
    return {"value": good / total, "low": low, "high": high, "n": total}


def mean(values: Floats) -> Row:
    """Return a mean with its 95 % interval (normal)."""
    half = 1.96 * float(np.std(values, ddof=1)) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    middle = float(np.mean(values))
    return {"value": middle, "low": middle - half, "high": middle + half, "n": len(values)}


def auc(score: Floats, held: Bools) -> float:
    """Return the probability that a held grasp outscores a failed one (Mann-Whitney); 0.5: no information."""
    good, bad = int(held.sum()), int((~held).sum())
    if not good or not bad:
        return float("nan")
    return float((rankdata(score)[held].sum() - good * (good + 1) / 2) / (good * bad))


def ranking(scores: list[Floats], held: list[Bools], draws: int = 400) -> Row:
    """Return the mean AUC over objects with a 95 % bootstrap interval over grasps.
    Objects whose grasps all have the same outcome are omitted. Grasps are ranked within each object, as in the planner,
    because scales differ between objects."""
    pairs = [(s, h) for s, h in zip(scores, held, strict=True) if 0 < h.sum() < len(h)]
    rng = np.random.default_rng(0)
    found = []
    for _ in range(draws):
        rows = [rng.integers(len(h), size=len(h)) for _, h in pairs]
        each = np.array([auc(s[r], h[r]) for (s, h), r in zip(pairs, rows, strict=True)])
        # A bootstrap sample may contain a single outcome.
        if (known := each[~np.isnan(each)]).size:
            found.append(known.mean())
    low, high = np.percentile(found, [2.5, 97.5])
    value = float(np.mean([auc(s, h) for s, h in pairs]))
    return {"value": value, "low": float(low), "high": float(high), "n": sum(len(h) for _, h in pairs)}
