"""Grasp planners behind one interface: see `port` for what a planner is and `registry` for those there are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from graspd.worker.engines.devices import check_device
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
from graspd.worker.planners.registry import GROUP, PLANNERS, joined, method, method_names, planner

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
    """Grasps by the named method with its own `options`; see `Planner`. Where others ask for grasps of the same pair in
    `run.meeting`, they are made in one launch with theirs, if the method knows how.

    Raises:
        InputError: the object does not fit into the gripper; see `fitting_pairs`.
    """
    fitting_pairs(hand, obj)
    alone = planner(method, options, in_scenes=wanted.placed is not None)
    together = joined(method, options) if run.meeting is not None else None
    if run.meeting is None or together is None:
        return alone(hand, obj, wanted, run)
    around = (wanted.rollout is not None, wanted.placed.fixed if wanted.placed is not None else None)
    key = (hand.content, obj.content, method, repr(options), wanted.fidelity.model_dump_json(), run.device, *around)

    def work(asked: Sequence[BatchRequest]) -> list[GraspSet | Exception]:
        try:
            return together(hand, obj, asked)
        finally:
            check_device(run.device)  # here, where nobody else has work on it

    found: GraspSet = run.meeting.ask(key, BatchRequest(wanted, run), work, size=wanted.count, cancelled=run.cancelled)
    return found
