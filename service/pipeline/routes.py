"""Routing of tasks to lists, by the versions of the living workers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from graspd.service.model.states import Stage
from graspd.service.model.workers import Capabilities, Requirements, WorkerBeat, own_ability


@dataclass(frozen=True)
class Route:
    apart: bool = False
    """Whether it enters a list that only some workers of its stage read."""
    held: str = ""
    """Why it is held back; "" if it is not."""


class Routes:
    def __init__(self, present: Sequence[WorkerBeat] = ()) -> None:
        self._here: dict[Stage, list[Capabilities]] = defaultdict(list)
        for beat in present:
            for stage in beat.stages:
                if beat.ability not in self._here[stage]:
                    self._here[stage].append(beat.ability)

    def place(self, need: Requirements) -> Route:
        """Return the route of a task.

        A task that all workers of its stage can do goes to all; one that some can do goes to those; one that none can
        do is held back. Without workers, this version's are assumed.
        """
        here = self._here.get(need.stage) or [own_ability()]
        lacking = {one.lacks(need) for one in here} - {""}
        if all(one.lacks(need) for one in here):
            return Route(held=f"held back, no worker that is here can do it: {'; '.join(sorted(lacking))}")
        return Route(apart=bool(lacking))
