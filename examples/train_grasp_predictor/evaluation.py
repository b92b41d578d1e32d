"""What grasps of an object that a network has not seen are worth, by the metrics and referee of datasets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from examples.train_grasp_predictor.samples import Example
from service.readers import Grasps, Shards
from service.store.shards import read_shard
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.referee.decomposition import ConvexPieces, decompose
from worker.quality.referee.displacement import simulated_displacement_cm
from worker.quality.referee.judge import judge
from worker.quality.table import measure

#: Contact threshold of areas and wrench spaces [m]; how many grasps of an object count for them, best epsilon first.
CONTACT_M: Final = 0.005
BEST: Final = 10
#: Quality columns with a value for each threshold, and with one.
_SWEPT: Final = ("epsilon", "contact_area_cm2", "wrench_volume")
_SINGLE: Final = ("intersection_volume_cm3", "simulated_displacement_cm")


@dataclass(frozen=True)
class Score:
    """Means over the grasps of one object; success and the ten best by epsilon as in the paper's tables."""

    grasps: int
    contact_area_cm2: float
    intersection_volume_cm3: float
    epsilon: float
    wrench_volume: float
    simulated_displacement_cm: float
    gsr: float


@dataclass(frozen=True)
class Held:
    """A held-back object: its pictures, and its convex pieces for the referee."""

    name: str
    model: ObjectModel
    pieces: ConvexPieces
    pictures: Sequence[Example]

    @classmethod
    def of(cls, name: str, model: ObjectModel, pictures: Sequence[Example]) -> Held:
        return cls(name, model, decompose(model), pictures)


def score(hand: HandModel, held: Held, grasps: GraspSet, *, friction: float = 1.0) -> Score:
    """Metrics at 5 mm as means of the ten best by epsilon; success over all."""
    obj, pieces = held.model, held.pieces
    columns = dict(measure(hand, obj, grasps, friction=friction))
    columns["quality/success"] = judge(hand, obj, grasps, level="certificate", pieces=pieces).success
    columns["quality/simulated_displacement_cm"] = simulated_displacement_cm(hand, obj, grasps.grasp, pieces=pieces)
    return _summary(columns)


def in_data(shards: Shards, name: str) -> Score:
    """What a source shows of an object, by the figures that stand in its shards."""
    paths = [f"quality/{field}" for field in (*_SWEPT, *_SINGLE, "success")]
    arrays = Grasps(shards.only(objects=[name]), paths, valid=False).arrays()
    first = shards.only(objects=[name]).of("base")[0]
    return _summary(arrays | {"quality/thresholds_m": read_shard(shards.path(first))["quality/thresholds_m"]})


def _summary(columns: Mapping[str, Any]) -> Score:
    at = int(np.argmin(np.abs(np.asarray(columns["quality/thresholds_m"]) - CONTACT_M)))
    found = {name: np.asarray(columns[f"quality/{name}"], float)[:, at] for name in _SWEPT}
    found |= {name: np.asarray(columns[f"quality/{name}"], float) for name in _SINGLE}
    best = np.argsort(-found["epsilon"])[:BEST]
    success = np.asarray(columns["quality/success"], float)
    means = {name: float(np.nanmean(values[best])) for name, values in found.items()}
    return Score(grasps=len(success), gsr=float(success.mean()), **means)
