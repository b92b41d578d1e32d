"""Rounds of a batch: their sizes and results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.domain import BATCH_SIZE
from graspd.worker.grasps import THRESHOLDS, GraspSet, join_columns, join_grasp_sets

Arrays = dict[str, NDArray[Any]]

#: Step of seeds between a batch's rounds. It exceeds all batch numbers: a job has at most 31,250 batches.
ROUND_STRIDE: Final = 1 << 20
#: Fewest grasps of a round, and of a part of a round.
SMALLEST_ROUND: Final = 8
SMALLEST_PART: Final = 8
#: Least share of valid grasps that is assumed for the next round, even if fewer were valid before. It limits the size
#: of rounds.
_LEAST_RATE: Final = 0.1


@dataclass
class Round:
    grasps: GraspSet
    columns: Arrays
    rows: NDArray[np.intp]
    """Row numbers of the selected grasps among the planned ones."""
    fates: NDArray[np.object_]
    """Result of each planned grasp: `kept`, or one of `service.model.planning.OUTCOMES`."""
    in_scene: dict[str, NDArray[np.bool_]]
    """In scenes, masks of planned grasps: clear, lifted, lifted at half friction."""
    seconds: dict[str, float]
    repeated: int = 0
    planned: list[GraspSet] = field(default_factory=list)

    @classmethod
    def concatenate(cls, parts: Sequence[Round]) -> Round:
        in_scene = {name: np.concatenate([part.in_scene[name] for part in parts]) for name in parts[0].in_scene}
        firsts = accumulate((len(part.fates) for part in parts), initial=0)
        seconds = {name: sum(part.seconds[name] for part in parts) for name in parts[0].seconds}
        return cls(
            join_grasp_sets([part.grasps for part in parts]),
            join_columns([part.columns for part in parts]),
            np.concatenate([part.rows + first for part, first in zip(parts, firsts, strict=False)]),
            np.concatenate([part.fates for part in parts]),
            in_scene,
            seconds,
            sum(part.repeated for part in parts),
            [grasps for part in parts for grasps in part.planned],
        )

    def split(self, sizes: Sequence[int]) -> list[Round]:
        """Split into parts of `sizes` planned grasps; each part gets its share of the seconds."""
        found, ends = [], list(accumulate(sizes, initial=0))
        for first, end in pairwise(ends):
            mine = np.flatnonzero((first <= self.rows) & (self.rows < end))
            grasps, columns = select_rows(self.grasps, self.columns, mine)
            in_scene = {name: rows[first:end] for name, rows in self.in_scene.items()}
            seconds = {name: value * (end - first) / max(1, ends[-1]) for name, value in self.seconds.items()}
            found.append(Round(grasps, columns, self.rows[mine] - first, self.fates[first:end], in_scene, seconds))
        return found


def next_round(wanted: int, valid: int, candidates: int, budget: int) -> int:
    """Return the number of grasps to plan next: the missing ones at the rate so far, plus 10 %.
    `wanted` is the number of valid grasps, `budget` the largest number of planned ones. The result is 0 if
    enough are found, or if the budget is used up."""
    if valid >= wanted or candidates >= budget:
        return 0
    if candidates == 0:
        return min(wanted, budget)
    return min(max(SMALLEST_ROUND, expected_need(wanted, valid, candidates)), BATCH_SIZE, budget - candidates)


def expected_need(wanted: int, valid: int, candidates: int) -> int:
    """Return the number of grasps expected to be enough at the rate so far, plus 10 %; see `next_round`."""
    if candidates == 0:
        return wanted
    return math.ceil(1.1 * (wanted - valid) / max(valid / candidates, _LEAST_RATE))


def split_rows(rows: range, cores: int) -> list[range]:
    """Split rows into contiguous, nearly equal parts: up to one per core, of `SMALLEST_PART` rows or more."""
    bounds = np.linspace(rows.start, rows.stop, max(1, min(cores, len(rows) // SMALLEST_PART)) + 1).astype(int)
    return [range(int(low), int(high)) for low, high in pairwise(bounds)]


def select_rows(grasps: GraspSet, columns: Arrays, rows: NDArray[np.intp]) -> tuple[GraspSet, Arrays]:
    return grasps.take(rows), {path: array if path == THRESHOLDS else array[rows] for path, array in columns.items()}
