"""The planner: starts around the hull, then annealed descent. All hands are given; info tells which would pass."""

from __future__ import annotations

import time
from typing import Final

import numpy as np
from pydantic import Field

from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.dfc import kernels
from worker.planners.dfc.schedule import STEPS
from worker.planners.dfc.search import Descent, Floats
from worker.planners.dfc.starts import sample_starts
from worker.planners.peers import grasp_set, ground_of, joined
from worker.planners.port import Method, Options, Planner, Wanted
from worker.planners.threads import Steps, cut, run_parts
from worker.run import Run
from worker.simulation.state import HandState

#: Force closure, distance and penetration that the source lets pass.
PASSES: Final = (0.3, 0.005, 0.001)


class DfcOptions(Options):
    """Options of `dfc`."""

    steps: int = Field(STEPS, ge=1, le=100_000, description="proposals of each hand")


class Dfc:
    """See `worker.planners.Planner`."""

    def __init__(self, options: DfcOptions) -> None:
        self.options = options

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: Wanted, run: Run) -> GraspSet:
        began = time.perf_counter()
        pair = ground_of(hand, obj, run.device, kernels)
        steps = Steps(wanted.count * (self.options.steps + 1), run)

        def work(indices: range) -> tuple[HandState, Floats]:
            starts = sample_starts(hand, obj, seed=wanted.seed, batch=wanted.batch, indices=indices)
            steps(len(indices), "starts")
            descent = Descent(pair, starts, [[wanted.seed, wanted.batch, index] for index in indices])
            descent.run(self.options.steps, steps)
            return descent.hands(), descent.energies()

        found = run_parts(cut(wanted.count, run), work)
        energies = np.concatenate([part[1] for part in found])
        passed = (energies[:, :3] < np.array(PASSES)).all(axis=1)
        return grasp_set(pair, joined([part[0] for part in found]), began, {"passed": passed.tolist()})


def _planner(options: DfcOptions) -> Planner:
    return Dfc(options)


METHOD: Final = Method(
    summary="annealed descent of force closure, distance and penetration energies of four contacts",
    source="R. Wang et al., DexGraspNet, ICRA 2023; T. Liu et al., Differentiable force closure, RA-L 2021",
    planner=_planner,
    options=DfcOptions,
    uses=("face_error_m",),
    quick={"steps": 60},
)
