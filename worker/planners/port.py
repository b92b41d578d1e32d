"""Interface of a grasp planner, implemented by `fast_graspd`, its peers and planners of third parties."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import Fidelity
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import PlacedGrasps

#: Scores (N,) of N grasps, in their scenes or around a free object (None). Smaller is better: below 1 no further
#: candidate is needed, from 2 on further ones pay. The third argument has the score to beat for each, inf if there is
#: none: a rollout may end once it is not better by a class (0, 1). Called by several threads at once.
Rollout = Callable[[GraspSet, PlacedGrasps | None, NDArray[np.float64]], NDArray[np.float64]]


class NoStartFound(InputError):
    """No grasp of a batch finds a start in its scenes."""


@dataclass(frozen=True)
class PlanRequest:
    """Request for grasps of a hand on an object."""

    count: int
    fidelity: Fidelity
    seed: int = 0
    batch: int = 0
    """Number of the batch among those of one seed."""
    placed: PlacedGrasps | None = None
    """Scenes: grasp i is in scene `placed.index[i]`; None: around a free object."""
    rollout: Rollout | None = None
    """Rollout that chooses among the candidates of a grasp; None: the planner's own merit chooses."""
    first: int = 0
    """Number of the first grasp within its batch; above 0 only for methods that plan batches `in_parts`."""
    others_have_place: bool = False
    """Whether grasps of the batch that are planned elsewhere have starts in their scenes.
    These grasps are then planned even if none has a start, and end blocked."""


class Planner(Protocol):
    """Plans `wanted.count` grasps of a hand on an object.

    A grasp depends on seed, batch and index within the batch only, not on the other grasps; on the CPU bit for bit.
    `run.progress(done, total, message)` may be called often; `run.cancelled()` is polled between launches.
    `wanted.placed` is None except for methods that plan `in_scenes`.

    Raises:
        TaskCancelled: `run.cancelled()` returned True.
        InputError: the pair cannot be grasped at all, with the reason.
        NoStartFound: in scenes, no grasp has a start and `wanted.others_have_place` is false.
    """

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: PlanRequest, run: ExecutionContext) -> GraspSet: ...


@dataclass(frozen=True)
class BatchRequest:
    wanted: PlanRequest
    run: ExecutionContext


class BatchPlanner(Protocol):
    """Plans several batches of a hand on an object in one launch, of one fidelity and on one device.
    All are around a free object, or all in scenes with the same supports and neighbours (`PlacedGrasps.fixed`).

    Each batch equals the result of the `Planner` alone; on the CPU bit for bit. A batch that fails is replaced by its
    error, TaskCancelled if its own `run.cancelled()` returned True; the others continue."""

    def __call__(
        self, hand: HandModel, obj: ObjectModel, asked: Sequence[BatchRequest]
    ) -> list[GraspSet | Exception]: ...


class Options(BaseModel):
    """Base of a method's own options, in addition to the fidelity that all methods share."""

    model_config = ConfigDict(frozen=True, extra="forbid")


@dataclass(frozen=True)
class Method:
    """A planner and its description."""

    summary: str
    """One line for lists."""
    source: str
    """Publication of the method."""
    planner: Callable[[Any], Planner]
    """Factory of the planner from the options."""
    in_scenes: bool = False
    """Whether it plans grasps in scenes, not only around free objects."""
    free: bool = True
    """Whether it plans around free objects."""
    in_parts: bool = False
    """Whether it plans the grasps of a batch from `PlanRequest.first` on without those before it."""
    options: type[Options] = Options
    """Class of its options."""
    uses: tuple[str, ...] = ()
    """Settings of `Fidelity` that affect its grasps; the others are ignored."""
    joined: Callable[[Any], BatchPlanner] | None = None
    """Factory of the planner of several batches in one launch; None: it plans them one by one."""
    files: Mapping[str, Callable[[Path], str]] = field(default_factory=dict)
    """Options that users give as files, each with a function that caches the file in this process.
    The function returns the file's digest, the option's value."""
    quick: Mapping[str, Any] = field(default_factory=dict)
    """Options for a short call, for warm-up and quick checks; its grasps need not be good."""

    @property
    def has_fidelities(self) -> bool:
        """Whether the fidelity changes more than the accuracy of the object's mesh."""
        return bool(set(self.uses) - {"face_error_m"})
