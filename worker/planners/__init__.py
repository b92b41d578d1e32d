"""Grasp planners behind one interface. A method is a function `Planner`; register it in `PLANNERS` under its name."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Final, Protocol

from service.domain import Fidelity
from service.errors import InputError
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel

Progress = Callable[[float, float, str], None]
Cancelled = Callable[[], bool]


class Planner(Protocol):
    """Makes `count` grasps of a hand on an object.

    The same seed, batch and index of a grasp within its batch give the same grasp, whatever the other grasps are; on
    the CPU bit for bit. `progress(done, total, message)` may be called often; `cancelled()` is polled between launches.

    Raises:
        TaskCancelled: when `cancelled()` answers True.
        InputError: when the pair cannot be grasped at all, with the reason.
    """

    def __call__(
        self,
        hand: HandModel,
        obj: ObjectModel,
        *,
        count: int,
        fidelity: Fidelity,
        seed: int,
        batch: int,
        threads: int,
        device: str,
        progress: Progress,
        cancelled: Cancelled,
    ) -> GraspSet: ...


#: Method name -> module and function. Modules are imported when used.
PLANNERS: Final[dict[str, tuple[str, str]]] = {
    "fast_graspd": ("worker.planners.fast_graspd.planner", "plan"),
}


def planner(method: str) -> Planner:
    """The planner of a method.

    Raises:
        InputError: unknown method.
    """
    if method not in PLANNERS:
        raise InputError(f"unknown method {method!r}; there are: {', '.join(sorted(PLANNERS))}")
    module, function = PLANNERS[method]
    found: Planner = getattr(import_module(module), function)
    return found


def synthesize(
    hand: HandModel,
    obj: ObjectModel,
    *,
    count: int,
    method: str = "fast_graspd",
    fidelity: Fidelity,
    seed: int = 0,
    batch: int = 0,
    threads: int = 0,
    device: str = "cpu",
    progress: Progress = lambda done, total, message: None,
    cancelled: Cancelled = lambda: False,
) -> GraspSet:
    """Grasps by the named method; see `Planner`."""
    return planner(method)(
        hand,
        obj,
        count=count,
        fidelity=fidelity,
        seed=seed,
        batch=batch,
        threads=threads,
        device=device,
        progress=progress,
        cancelled=cancelled,
    )
