"""Grasp planners behind one interface: see `port` for what a planner is and `registry` for those there are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from service.model.domain import Fidelity
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.port import Cancelled, Method, Options, Planner, Progress
from worker.planners.registry import GROUP, PLANNERS, method, method_names, planner, scene_planner
from worker.simulation.surroundings import Placed

__all__ = [
    "GROUP",
    "PLANNERS",
    "Cancelled",
    "Method",
    "Options",
    "Planner",
    "Progress",
    "method",
    "method_names",
    "planner",
    "scene_planner",
    "synthesize",
]


def synthesize(
    hand: HandModel,
    obj: ObjectModel,
    *,
    count: int,
    method: str = "fast_graspd",
    fidelity: Fidelity,
    options: Mapping[str, Any] | None = None,
    seed: int = 0,
    batch: int = 0,
    threads: int = 0,
    device: str = "cpu",
    progress: Progress = lambda done, total, message: None,
    cancelled: Cancelled = lambda: False,
    placed: Placed | None = None,
) -> GraspSet:
    """Grasps by the named method with its own `options`, each in its scene where they are `placed`; see `Planner`."""
    common: dict[str, Any] = {
        "count": count, "fidelity": fidelity, "seed": seed, "batch": batch, "threads": threads, "device": device,
        "progress": progress, "cancelled": cancelled,
    }  # fmt: skip
    if placed is None:
        return planner(method, options)(hand, obj, **common)
    return scene_planner(method, options)(hand, obj, **common, placed=placed)
