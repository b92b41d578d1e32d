"""Where a task waits, given the versions of the workers that are there."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from graspd.service.model.states import Stage
from graspd.service.model.workers import Capabilities, Requirements, WorkerBeat, own_ability


@dataclass(frozen=True)
class Route:
    """Where a task goes."""

    apart: bool = False
    """Into a list that only some workers of its stage look into."""
    held: str = ""
    """Why it is held back; "" if it is not."""


class Routes:
    """What the living workers of each stage can do."""

    def __init__(self, present: Sequence[WorkerBeat] = ()) -> None:
        self._here: dict[Stage, list[Capabilities]] = defaultdict(list)
        for beat in present:
            for stage in beat.stages:
                if beat.ability not in self._here[stage]:
                    self._here[stage].append(beat.ability)

    def place(self, need: Requirements) -> Route:
        """Of a task.

        What every worker of its stage can do goes to all of them, and what some can do to those. What none can do is
        held back. While there is no worker, those of this version are expected.
        """
        here = self._here.get(need.stage) or [own_ability()]
        lacking = {one.lacks(need) for one in here} - {""}
        if all(one.lacks(need) for one in here):
            return Route(held=f"held back, no worker that is here can do it: {'; '.join(sorted(lacking))}")
        return Route(apart=bool(lacking))
