"""Rounds of a batch: how many grasps each plans, and what came of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.domain import BATCH_SIZE
from graspd.worker.grasps import THRESHOLDS, GraspSet, joined, joined_columns

Arrays = dict[str, NDArray[Any]]

#: Rounds of one batch draw their grasps where no batch of a job does: a job has at most 31,250 batches.
ROUND_STRIDE: Final = 1 << 20
#: Fewest grasps worth a round, and a priority.
SMALLEST_ROUND: Final = 8
LANE: Final = 8
#: What a round expects to be valid at least, however bad the rounds before were: rounds stay finite and few.
_LEAST_RATE: Final = 0.1


@dataclass
class Round:
    """Grasps of one round that are worth keeping."""

    grasps: GraspSet
    columns: Arrays
    rows: NDArray[np.intp]
    """Which of those that were planned they are."""
    fates: NDArray[np.object_]
    """What became of each grasp that was planned: kept, or one of `service.model.planning.OUTCOMES`."""
    in_scene: dict[str, NDArray[np.bool_]]
    """In scenes: which of those that were planned were clear, lifted, lifted hard."""
    seconds: dict[str, float]
    """Wall time of planning, validating and measuring [s]."""
    repeated: int = 0
    """In scenes: how often its grasps set out again."""
    planned: list[GraspSet] = field(default_factory=list)
    """All of its grasps."""

    @classmethod
    def joined(cls, parts: Sequence[Round]) -> Round:
        """All grasps of several."""
        in_scene = {name: np.concatenate([part.in_scene[name] for part in parts]) for name in parts[0].in_scene}
        firsts = accumulate((len(part.fates) for part in parts), initial=0)
        seconds = {name: sum(part.seconds[name] for part in parts) for name in parts[0].seconds}
        return cls(
            joined([part.grasps for part in parts]),
            joined_columns([part.columns for part in parts]),
            np.concatenate([part.rows + first for part, first in zip(parts, firsts, strict=False)]),
            np.concatenate([part.fates for part in parts]),
            in_scene,
            seconds,
            sum(part.repeated for part in parts),
            [grasps for part in parts for grasps in part.planned],
        )

    def split(self, sizes: Sequence[int]) -> list[Round]:
        """The parts of so many planned grasps each; of the seconds each has its share."""
        found, ends = [], list(accumulate(sizes, initial=0))
        for first, end in pairwise(ends):
            mine = np.flatnonzero((first <= self.rows) & (self.rows < end))
            grasps, columns = taken(self.grasps, self.columns, mine)
            in_scene = {name: rows[first:end] for name, rows in self.in_scene.items()}
            seconds = {name: value * (end - first) / max(1, ends[-1]) for name, value in self.seconds.items()}
            found.append(Round(grasps, columns, self.rows[mine] - first, self.fates[first:end], in_scene, seconds))
        return found


def next_round(wanted: int, valid: int, candidates: int, budget: int) -> int:
    """Grasps to plan next: as many as the rate so far promises to be enough, and a tenth more.

    Args:
        wanted: valid grasps wanted in all.
        valid: found so far.
        tried: planned so far.
        budget: planned at most.

    Returns:
        0 when enough are found or the budget is used up.
    """
    if valid >= wanted or candidates >= budget:
        return 0
    if candidates == 0:
        return min(wanted, budget)
    return min(max(SMALLEST_ROUND, enough(wanted, valid, candidates)), BATCH_SIZE, budget - candidates)


def enough(wanted: int, valid: int, candidates: int) -> int:
    """Grasps that the rate so far promises to be enough, and a tenth more; see `next_round`."""
    if candidates == 0:
        return wanted
    return math.ceil(1.1 * (wanted - valid) / max(valid / candidates, _LEAST_RATE))


def lanes_of(rows: range, cores: int) -> list[range]:
    """Rows of a round in contiguous, nearly equal parts: as many as there are cores, and of `LANE` grasps at least."""
    bounds = np.linspace(rows.start, rows.stop, max(1, min(cores, len(rows) // LANE)) + 1).astype(int)
    return [range(int(low), int(high)) for low, high in pairwise(bounds)]


def taken(grasps: GraspSet, columns: Arrays, rows: NDArray[np.intp]) -> tuple[GraspSet, Arrays]:
    """Some of the grasps (K,) with their columns."""
    return grasps.take(rows), {path: array if path == THRESHOLDS else array[rows] for path, array in columns.items()}
