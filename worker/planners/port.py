"""Interface of a grasp planner, implemented by `fast_graspd`, baselines and third-party planners."""

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
from graspd.worker.planners.requirements import NOTHING, Requirements
from graspd.worker.simulation.environment import PlacedGrasps

#: Returns scores (N,) of grasps in their scenes or, for None, around a free object. Smaller is better: below 1 a grasp
#: holds at half friction, below 2 at full friction; from 2 on, more candidates are worth their cost. The third argument
#: is the score to beat for each grasp, inf without one. A rollout may stop early if it cannot beat this score. Several
#: threads may call the function at once.
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
    """Scenes, with grasp i in scene `placed.index[i]`; None if the object is free."""
    rollout: Rollout | None = None
    """Rollout that scores the candidates of a grasp; if None, the planner's own merit selects one."""
    first: int = 0
    """Number of the first grasp within its batch; above 0 only for methods with `in_parts`."""
    requirements: Requirements = NOTHING
    """Requirements on the grasps; equal for all batches of one launch."""
    others_have_place: bool = False
    """Whether other parts of the batch, planned elsewhere, have starts in their scenes.
    If so, the grasps of this part are returned as blocked even if none of them has a start."""


class Planner(Protocol):
    """Plans `wanted.count` grasps of a hand on an object.
    A grasp depends only on seed, batch and its index within the batch, not on the other grasps. On the CPU, results are
    bit-identical. `run.progress(done, total, message)` may be called often; `run.cancelled()` is polled between
    launches. `wanted.placed` is None except for methods with `in_scenes`. Raises TaskCancelled: `run.cancelled()`
    returned True. InputError: the pair cannot be grasped; the message has the reason. NoStartFound: in scenes, no grasp
    has a start and `wanted.others_have_place` is false."""

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: PlanRequest, run: ExecutionContext) -> GraspSet: ...


@dataclass(frozen=True)
class BatchRequest:
    wanted: PlanRequest
    run: ExecutionContext


class BatchPlanner(Protocol):
    """Plans several batches of a hand on an object in one launch, with one fidelity and on one device.
    All batches are around a free object, or all are in scenes with the same supports and neighbours
    (`PlacedGrasps.fixed`). Each batch equals the result of the `Planner` for this batch alone; on the CPU bit for bit.
    The result of a failed batch is its error: TaskCancelled if its own `run.cancelled()` returned True. The other
    batches continue."""

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
    """Whether it can start a batch at the grasp `PlanRequest.first`, without planning the grasps before it."""
    options: type[Options] = Options
    """Class of its options."""
    uses: tuple[str, ...] = ()
    """Settings of `Fidelity` that affect its grasps; other settings are ignored."""
    joined: Callable[[Any], BatchPlanner] | None = None
    """Factory of the planner of several batches in one launch; if None, batches are planned one by one."""
    files: Mapping[str, Callable[[Path], str]] = field(default_factory=dict)
    """Options that users give as files, each with a function that caches the file in this process.
    The function returns the file's digest, which becomes the option's value."""
    quick: Mapping[str, Any] = field(default_factory=dict)
    """Options for a short call, for warm-up and quick checks; its grasps need not be good."""

    @property
    def has_fidelities(self) -> bool:
        """Whether the fidelity changes more than the accuracy of the object's mesh."""
        return bool(set(self.uses) - {"face_error_m"})
