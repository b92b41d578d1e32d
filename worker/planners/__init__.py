"""Grasp planners behind one interface: `port` defines the interface, `registry` lists the planners."""

from collections.abc import Mapping, Sequence
from typing import Any

from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fitting import fitting_pairs
from graspd.worker.planners.port import (
    BatchPlanner,
    BatchRequest,
    Method,
    NoStartFound,
    Options,
    Planner,
    PlanRequest,
    Rollout,
)
from graspd.worker.planners.registry import GROUP, PLANNERS, batch_planner, method, method_names, planner

__all__ = [
    "GROUP",
    "PLANNERS",
    "BatchPlanner",
    "BatchRequest",
    "ExecutionContext",
    "Method",
    "NoStartFound",
    "Options",
    "PlanRequest",
    "Planner",
    "Rollout",
    "fitting_pairs",
    "method",
    "method_names",
    "planner",
    "synthesize",
    "synthesize_batches",
]


def synthesize(
    hand: HandModel,
    obj: ObjectModel,
    wanted: PlanRequest,
    run: ExecutionContext = DEFAULT_CONTEXT,
    *,
    method: str = "fast_graspd",
    options: Mapping[str, Any] | None = None,
) -> GraspSet:
    """Plan grasps with the named method and its `options`; see `Planner`.
    Raises InputError: the object does not fit into the gripper; see `fitting_pairs`."""
    fitting_pairs(hand, obj)
    return planner(method, options, in_scenes=wanted.placed is not None)(hand, obj, wanted, run)


def synthesize_batches(
    hand: HandModel,
    obj: ObjectModel,
    asked: Sequence[BatchRequest],
    *,
    method: str = "fast_graspd",
    options: Mapping[str, Any] | None = None,
) -> list[GraspSet | Exception]:
    """Plan batches of one job, in one launch if the method supports it; see `BatchPlanner`."""
    if (together := batch_planner(method, options)) is not None:
        return together(hand, obj, asked)
    found: list[GraspSet | Exception] = []
    for one in asked:
        try:
            found.append(synthesize(hand, obj, one.wanted, one.run, method=method, options=options))
        except Exception as error:
            found.append(error)
    return found
