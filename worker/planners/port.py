"""What a grasp planner is: the one interface that `fast_graspd`, its peers and planners of third parties fill."""

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

#: Scores (N,) of N grasps, in their scenes or around a free object (None): the smaller the better, below 1 good enough
#: to look at no other candidate, from 2 on so bad that others are worth their time. The third argument has the score of
#: what each would replace, inf where there is nothing: a trial may end as soon as it is not better by a class (0, 1).
#: Called by several threads at once.
Rollout = Callable[[GraspSet, PlacedGrasps | None, NDArray[np.float64]], NDArray[np.float64]]


class NoStartFound(InputError):
    """No grasp of a batch finds where to start in its scenes."""


@dataclass(frozen=True)
class PlanRequest:
    """Which grasps of a hand on an object."""

    count: int
    fidelity: Fidelity
    seed: int = 0
    batch: int = 0
    """Number of the batch among those of one seed."""
    placed: PlacedGrasps | None = None
    """Their scenes: grasp i in scene `placed.index[i]`; None: around a free object."""
    rollout: Rollout | None = None
    """What several candidates of a grasp go through before one is chosen; None: the planner's own merit chooses."""
    first: int = 0
    """Number of the first grasp within its batch; above 0 for methods that make batches `in_parts` only."""
    others_have_place: bool = False
    """Whether grasps of the batch that are made elsewhere find where to start in their scenes: then these are made even
    if none of them does, and end blocked."""


class Planner(Protocol):
    """Makes `wanted.count` grasps of a hand on an object.

    The same seed, batch and index of a grasp within its batch give the same grasp, whatever the other grasps are; on
    the CPU bit for bit. `run.progress(done, total, message)` may be called often; `run.cancelled()` is polled between
    launches. `wanted.placed` is None but for methods that plan `in_scenes`.

    Raises:
        TaskCancelled: when `run.cancelled()` answers True.
        InputError: when the pair cannot be grasped at all, with the reason.
        NoPlace: in scenes, when nowhere is a place to start, though `wanted.others_have_place` is not told.
    """

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: PlanRequest, run: ExecutionContext) -> GraspSet: ...


@dataclass(frozen=True)
class BatchRequest:
    """One of several batches that are asked for at once."""

    wanted: PlanRequest
    run: ExecutionContext


class BatchPlanner(Protocol):
    """Makes several batches of a hand on an object in one launch: of one fidelity, on one device, all around a free
    object or all in scenes with the same supports and neighbours (`Placed.fixed`).

    Each is as the `Planner` makes it alone; on the CPU bit for bit. What is the matter with one batch is given in its
    place, a TaskCancelled where its own `run.cancelled()` answers True; the others go on.
    """

    def __call__(
        self, hand: HandModel, obj: ObjectModel, asked: Sequence[BatchRequest]
    ) -> list[GraspSet | Exception]: ...


class Options(BaseModel):
    """Base of a method's own options: those that the fidelity, which all methods share, does not have."""

    model_config = ConfigDict(frozen=True, extra="forbid")


@dataclass(frozen=True)
class Method:
    """A planner with what people should know of it."""

    summary: str
    """One line for lists."""
    source: str
    """Where the method is published."""
    planner: Callable[[Any], Planner]
    """From the options to the planner."""
    in_scenes: bool = False
    """Whether it plans grasps for the scenes they are in, or around free objects only."""
    free: bool = True
    """Whether it plans around free objects."""
    in_parts: bool = False
    """Whether it makes the grasps of a batch from `Wanted.first` on without those before it."""
    options: type[Options] = Options
    """The options it takes."""
    uses: tuple[str, ...] = ()
    """Knobs of `Fidelity` that move its grasps; the others are ignored."""
    joined: Callable[[Any], BatchPlanner] | None = None
    """From the options to what makes several batches in one launch; None: it makes them one after the other."""
    files: Mapping[str, Callable[[Path], str]] = field(default_factory=dict)
    """Options that are files to who has them: each with what keeps such a file in this process and gives its digest,
    which is the option's value."""
    quick: Mapping[str, Any] = field(default_factory=dict)
    """Options with which a call is short: to warm up, and to try things out. Its grasps need not be good."""

    @property
    def has_fidelities(self) -> bool:
        """Whether a fidelity changes more than how closely the object's mesh is followed."""
        return bool(set(self.uses) - {"face_error_m"})
