"""Batches that are made in one launch: which grasp of it is whose, and which of them are out.

A batch is out when it was cancelled or when something is the matter with it alone; the others go on without it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError, TaskCancelled
from graspd.service.model.fidelity import Fidelity
from graspd.service.model.integers import distinct_values
from graspd.service.model.transforms import Floats
from graspd.worker.grasps import GraspSet
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.scene_starts import free_ways
from graspd.worker.planners.fast_graspd.schedule import WarmStart, in_scene, with_rollout
from graspd.worker.planners.fast_graspd.starts import start_generator
from graspd.worker.planners.port import BatchRequest
from graspd.worker.planners.threads import StepCounter
from graspd.worker.simulation.environment import PlacedGrasps, placed_together

Rows = NDArray[np.intp]


class Batches:
    """The grasps of several batches, one batch after the other; a row is a grasp."""

    def __init__(self, asked: Sequence[BatchRequest], obj: ObjectModel, warm: WarmStart | None = None) -> None:
        """All batches have one fidelity, and all or none of them are in scenes with the same fixed surroundings.
        `warm`, in scenes: where their hands set out; None: where `scene_starts` finds."""
        self.asked, self.warm = asked, warm
        wanted = [one.wanted for one in asked]
        in_scenes = wanted[0].placed is not None
        self.fidelity: Fidelity = _adapted(wanted[0].fidelity, in_scenes=in_scenes, tried=self.has_rollout)
        if warm is not None:
            self.fidelity = warm.adapted(self.fidelity)
        counts = [one.count for one in wanted]
        self.owner = np.repeat(np.arange(len(asked)), counts)
        """(n,) the batch of each row."""
        self.index = np.concatenate([one.first + np.arange(one.count) for one in wanted])
        """(n,) number of each row within its batch."""
        self.opened = np.zeros(len(self.owner), bool)
        """(n,) whether hands of a row set out more open than their pre-shape: in that they had no place."""
        self.errors: dict[int, Exception] = {}
        """What became of the batches that are out."""
        self._steps = [StepCounter(one.wanted.count * (hands(self.fidelity) + 1), one.run) for one in asked]
        placed = [one.placed for one in wanted if one.placed is not None]
        self.placed: PlacedGrasps | None = placed_together(placed) if placed else None
        self.ways: list[Floats] = []
        """Free ways of each scene."""
        for owner, scenes in enumerate(placed):
            self._find_ways(owner, scenes, obj)

    def _find_ways(self, owner: int, scenes: PlacedGrasps, obj: ObjectModel) -> None:
        try:
            # Whole or not at all: those of a scene are found by its number.
            self.ways += [free_ways(scene, obj) for scene in scenes.scenes]
        except InputError as error:
            self.ways += [np.zeros((0, 3))] * len(scenes.scenes)
            self.put_out(owner, error)

    @property
    def has_rollout(self) -> bool:
        """Whether candidates go through a trial. Around a free object they do where the fidelity seats several."""
        first = self.asked[0].wanted
        several = first.placed is not None or first.fidelity.finalists > 1
        return several and all(one.wanted.rollout is not None for one in self.asked)

    def put_out(self, owner: int, error: Exception) -> None:
        """The batch is made no further; what became of it first stands."""
        self.errors.setdefault(owner, error)

    def going(self, rows: Rows) -> NDArray[np.bool_]:
        """(n,) whether the batches of these rows are still made."""
        return ~np.isin(self.owner[rows], list(self.errors))

    def left(self) -> Rows:
        """Rows of the batches that are still made.

        Raises:
            Exception: what became of the first batch, if all of them are out.
        """
        rows = np.flatnonzero(self.going(np.arange(len(self.owner))))
        if not len(rows):
            raise self.errors[min(self.errors)]
        return rows

    def step(self, rows: Rows, work: float, message: str) -> None:
        """So much work was done for each of the rows; batches that are cancelled are put out.

        Raises:
            Exception: what became of the first batch, if all of them are out.
        """
        owners, counts = np.unique(self.owner[rows], return_counts=True)
        for owner, count in zip(owners.tolist(), counts.tolist(), strict=True):
            if owner not in self.errors:
                try:
                    self._steps[owner](count * work, message)
                except TaskCancelled as error:
                    self.put_out(owner, error)
        if len(self.errors) == len(self.asked):
            raise self.errors[min(self.errors)]

    def generators(self, rows: Rows, attempt: Rows) -> list[np.random.Generator]:
        """Random numbers of the starts of these rows at an attempt (n,) each, those of one grasp side by side."""
        starts = self.fidelity.starts
        wanted = [self.asked[owner].wanted for owner in self.owner[rows].tolist()]
        numbers = zip(wanted, self.index[rows].tolist(), attempt.tolist(), strict=True)
        return [
            start_generator(one.seed, one.batch, i, k)
            for one, i, made in numbers
            for k in range(made * starts, (made + 1) * starts)
        ]

    def rollout(self, grasps: GraspSet, rows: Rows, beat: Floats) -> Floats:
        """Scores (n,) of grasps for these rows that have scores `beat` (n,) so far, each by the trial of its own batch;
        of a batch that is out every grasp is good enough."""
        owners, scores = self.owner[rows], np.zeros(len(grasps))
        placed = self.placed.take(rows) if self.placed is not None else None
        for owner in distinct_values(owners):
            rollout, own = self.asked[owner].wanted.rollout, np.flatnonzero(owners == owner)
            if rollout is None or owner in self.errors:
                continue
            try:
                self._steps[owner](0, "rollout")
                scores[own] = rollout(grasps.take(own), placed.take(own) if placed is not None else None, beat[own])
            except Exception as error:
                self.put_out(owner, error)
        return scores


def _adapted(fidelity: Fidelity, *, in_scenes: bool, tried: bool) -> Fidelity:
    if in_scenes:
        return in_scene(fidelity)
    return with_rollout(fidelity) if tried else fidelity


def finalists(fidelity: Fidelity) -> int:
    """Hands of a grasp that enter the fine phase: no more than set out."""
    return min(fidelity.finalists, fidelity.starts)


def hands(fidelity: Fidelity) -> int:
    """Hand iterations that one grasp costs."""
    return fidelity.starts * fidelity.coarse_iterations + finalists(fidelity) * fidelity.fine_iterations
