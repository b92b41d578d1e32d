"""Batches planned in one launch: the batch of each grasp, and which batches have stopped.

A batch stops when it is cancelled or fails; the other batches continue."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError, TaskCancelled
from graspd.service.model.fidelity import Fidelity
from graspd.service.model.transforms import Floats
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.scene_starts import free_directions, no_room_error
from graspd.worker.planners.fast_graspd.schedule import WarmStart, fidelity_in_scenes
from graspd.worker.planners.fast_graspd.starts import start_generator
from graspd.worker.planners.port import BatchRequest
from graspd.worker.planners.threads import StepCounter
from graspd.worker.simulation.environment import PlacedGrasps, join_placed_grasps

Rows = NDArray[np.intp]


class Batches:
    """Grasps of several batches, one batch after the other; a row is a grasp."""

    def __init__(
        self,
        asked: Sequence[BatchRequest],
        obj: ObjectModel,
        warm: WarmStart | None = None,
        hand: HandModel | None = None,
    ) -> None:
        """All batches have one fidelity; all or none are in scenes, with the same supports and neighbours.
        In scenes, `warm` proposes the starts of hands; without it, `scene_starts` finds them."""
        self.asked, self.warm, self.hand = asked, warm, hand
        wanted = [one.wanted for one in asked]
        self.requirements = wanted[0].requirements
        self.fidelity = wanted[0].fidelity
        if wanted[0].placed is not None:
            self.fidelity = fidelity_in_scenes(self.fidelity)
        elif self.has_rollout and not self.requirements.out_of_line:
            # Retries replace half of the initial starts. Out of line, further starts cost less than retries.
            self.fidelity = self.fidelity.model_copy(update={"starts": -(-self.fidelity.starts // 2)})
        if warm is not None:
            self.fidelity = warm.adapted(self.fidelity)
        counts = [one.count for one in wanted]
        self.owner = np.repeat(np.arange(len(asked)), counts)
        """(n,) batch of each row."""
        self.index = np.concatenate([one.first + np.arange(one.count) for one in wanted])
        """(n,) number of each row within its batch."""
        self.opened = np.zeros(len(self.owner), bool)
        """(n,) whether the hands of a row start further open, because no start in their pre-shape was clear."""
        self.errors: dict[int, Exception] = {}
        """Errors of the batches that stopped."""
        known = self.fidelity
        hands = known.starts * known.coarse_iterations + finalist_count(known) * known.fine_iterations
        self._steps = [StepCounter(one.wanted.count * (hands + 1), one.run) for one in asked]
        placed = [one.placed for one in wanted if one.placed is not None]
        self.placed: PlacedGrasps | None = join_placed_grasps(placed) if placed else None
        self.ways: list[Floats] = []
        """Free directions of each scene."""
        for owner, scenes in enumerate(placed):
            if hand is not None and not self.requirements.has_room(hand, scenes).any():
                self.fail(owner, no_room_error(hand, len(scenes.object_pose)))
            try:
                # All batches have scenes here, so `owner` is the number of the batch.
                self.ways += [
                    self.requirements.retreats(free_directions(scene, obj), scenes, number)
                    for number, scene in enumerate(scenes.scenes)
                ]
            except InputError as error:
                self.ways += [np.zeros((0, 3))] * len(scenes.scenes)
                self.fail(owner, error)

    @property
    def has_rollout(self) -> bool:
        """Whether candidates are tested in rollouts; for a free object only with several finalists."""
        first = self.asked[0].wanted
        several = first.placed is not None or first.fidelity.finalists > 1
        return several and all(one.wanted.rollout is not None for one in self.asked)

    def fail(self, owner: int, error: Exception) -> None:
        self.errors.setdefault(owner, error)

    def is_active(self, rows: Rows) -> NDArray[np.bool_]:
        """Return a mask (n,) of the rows whose batches are still planned."""
        return ~np.isin(self.owner[rows], list(self.errors))

    def active_rows(self) -> Rows:
        """Return rows of batches that are still planned; raise the first batch's error if all have stopped."""
        rows = np.flatnonzero(self.is_active(np.arange(len(self.owner))))
        if not len(rows):
            raise self.errors[min(self.errors)]
        return rows

    def step(self, rows: Rows, work: float, message: str) -> None:
        """Report an amount of work for each of the rows; stop batches that are cancelled.
        Raise the first batch's error if all have stopped."""
        owners, counts = np.unique(self.owner[rows], return_counts=True)
        for owner, count in zip(owners.tolist(), counts.tolist(), strict=True):
            if owner not in self.errors:
                try:
                    self._steps[owner](count * work, message)
                except TaskCancelled as error:
                    self.fail(owner, error)
        if len(self.errors) == len(self.asked):
            raise self.errors[min(self.errors)]

    def generators(self, rows: Rows, attempt: Rows) -> list[np.random.Generator]:
        """Return generators for starts of these rows at attempts (n,); those of one grasp are adjacent."""
        starts = self.fidelity.starts
        wanted = [self.asked[owner].wanted for owner in self.owner[rows].tolist()]
        numbers = zip(wanted, self.index[rows].tolist(), attempt.tolist(), strict=True)
        return [
            start_generator(one.seed, one.batch, i, k)
            for one, i, made in numbers
            for k in range(made * starts, (made + 1) * starts)
        ]

    def rollout(self, grasps: GraspSet, rows: Rows, beat: Floats) -> Floats:
        """Return scores (n,) of grasps `rows` in their batches' rollouts; `beat` (n,) are the scores to beat.
        Grasps of stopped batches have score 0."""
        owners, scores = self.owner[rows], np.zeros(len(grasps))
        placed = self.placed.take(rows) if self.placed is not None else None
        for owner in sorted(set(owners.tolist())):
            rollout, own = self.asked[owner].wanted.rollout, np.flatnonzero(owners == owner)
            if rollout is None or owner in self.errors:
                continue
            try:
                self._steps[owner](0, "rollout")
                scores[own] = rollout(grasps.take(own), placed.take(own) if placed is not None else None, beat[own])
            except Exception as error:
                self.fail(owner, error)
        return scores


def finalist_count(fidelity: Fidelity) -> int:
    """Return the number of hands per grasp that enter the fine phase, at most the number of starts."""
    return min(fidelity.finalists, fidelity.starts)
