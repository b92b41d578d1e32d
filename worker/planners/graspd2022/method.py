"""The planner: free starts, descent with relaxed forces, no selection and no repair: as the source has it."""

from __future__ import annotations

import time
from typing import Final

import numpy as np
from pydantic import Field

from service.model.transforms import Floats
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.fast_graspd.pairs import Pair
from worker.planners.graspd2022 import kernels
from worker.planners.graspd2022.search import Search
from worker.planners.peers import Kept, free_starts, grasp_set, ground_of, joined
from worker.planners.port import Method, Options, Planner, Wanted
from worker.planners.threads import Steps, cut, run_parts
from worker.run import Run
from worker.simulation.data import HandState


class Graspd2022Options(Options):
    """Options of `graspd2022`."""

    steps: int = Field(10_000, ge=1, le=100_000, description="iterations of descent")
    grid: int = Field(128, ge=16, le=256, description="cells of the distance grid along its longest side")


_searches: Final = Kept(Search)


class Graspd2022:
    """See `worker.planners.Planner`."""

    def __init__(self, options: Graspd2022Options) -> None:
        self.options = options

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: Wanted, run: Run) -> GraspSet:
        began = time.perf_counter()
        pair: Pair = ground_of(hand, obj, run.device, kernels)
        search = _searches(pair, self.options.grid)
        steps = Steps(wanted.count * (self.options.steps + 1), run)

        def work(indices: range) -> tuple[HandState, Floats]:
            starts = free_starts(pair, seed=wanted.seed, batch=wanted.batch, indices=indices)
            steps(len(indices), "starts")
            return search.run(starts, steps=self.options.steps, tell=steps)

        found = run_parts(cut(wanted.count, run), work)
        residual = np.concatenate([part[1] for part in found])
        return grasp_set(pair, joined([part[0] for part in found]), began, {"residual": residual.round(4).tolist()})


def _planner(options: Graspd2022Options) -> Planner:
    return Graspd2022(options)


METHOD: Final = Method(
    summary="descent on a distance grid with force-based contact, relaxed by contact-invariant forces",
    source="D. Turpin et al., Grasp'D: Differentiable Contact-rich Grasp Synthesis, ECCV 2022",
    planner=_planner,
    options=Graspd2022Options,
    uses=("face_error_m",),
    quick={"steps": 60},
)
