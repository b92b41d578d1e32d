"""Where hands set out in scenes when another method proposes it; descent, trials and verdicts are the same."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from service.model.fidelity import Fidelity
from service.model.transforms import Floats
from worker.simulation.data import HandState
from worker.simulation.model import Model
from worker.simulation.surroundings import Placed


class WarmStart(Protocol):
    """Starts of grasps in scenes."""

    def adapted(self, fidelity: Fidelity) -> Fidelity:
        """The fidelity of grasps in scenes, as `schedule.in_scene` gives it, with as many starts and finalists as these
        starts need."""

    def __call__(
        self, model: Model, generators: list[np.random.Generator], *, each: int, placed: Placed, ways: Sequence[Floats]
    ) -> tuple[HandState, Floats]:
        """See `scene_starts.clear_scene_starts`."""
