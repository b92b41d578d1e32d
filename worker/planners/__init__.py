"""Grasp planners behind one interface: see `port` for what a planner is and `registry` for those there are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.fitting import fitting_pairs
from worker.planners.port import Asked, Joined, Method, NoPlace, Options, Planner, Trial, Wanted
from worker.planners.registry import GROUP, PLANNERS, joined, method, method_names, planner
from worker.run import ALONE, Run

__all__ = [
    "GROUP",
    "PLANNERS",
    "Asked",
    "Joined",
    "Method",
    "NoPlace",
    "Options",
    "Planner",
    "Run",
    "Trial",
    "Wanted",
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
    wanted: Wanted,
    run: Run = ALONE,
    *,
    method: str = "fast_graspd",
    options: Mapping[str, Any] | None = None,
) -> GraspSet:
    """Grasps by the named method with its own `options`; see `Planner`.

    Raises:
        InputError: the object does not fit into the gripper; see `fitting_pairs`.
    """
    fitting_pairs(hand, obj)
    return planner(method, options, in_scenes=wanted.placed is not None)(hand, obj, wanted, run)


def synthesize_batches(
    hand: HandModel,
    obj: ObjectModel,
    asked: Sequence[Asked],
    *,
    method: str = "fast_graspd",
    options: Mapping[str, Any] | None = None,
) -> list[GraspSet | Exception]:
    """Batches of one job in one launch, if the method knows how, else one after the other; see `Joined`."""
    if (together := joined(method, options)) is not None:
        return together(hand, obj, asked)
    found: list[GraspSet | Exception] = []
    for one in asked:
        try:
            found.append(synthesize(hand, obj, one.wanted, one.run, method=method, options=options))
        except Exception as error:
            found.append(error)
    return found
