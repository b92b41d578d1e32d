"""The planner: a chain of simulated annealing for each grasp, then autograsp from the chain's best state."""

from __future__ import annotations

import time
from typing import Final

from pydantic import Field

from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.autograsp import kernels as closing_kernels
from worker.planners.autograsp.closing import Closer
from worker.planners.graspit import kernels
from worker.planners.graspit.schedule import FIRST_STEP
from worker.planners.graspit.search import Search
from worker.planners.peers import Kept, grasp_set, ground_of, joined
from worker.planners.port import Method, Options, Planner, Wanted
from worker.planners.threads import Steps, cut, run_parts
from worker.run import Run
from worker.simulation.data import HandState

_searches: Final = Kept(Search)


class GraspitOptions(Options):
    """Options of `graspit`."""

    steps: int = Field(
        70_000, gt=FIRST_STEP, le=1_000_000, description=f"step at which annealing ends; it counts from {FIRST_STEP}"
    )
    keep: int = Field(1, ge=1, le=20, description="grasps taken from the list of best states of each chain")


class Graspit:
    """See `worker.planners.Planner`."""

    def __init__(self, options: GraspitOptions) -> None:
        self.options = options

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: Wanted, run: Run) -> GraspSet:
        began = time.perf_counter()
        pair = ground_of(hand, obj, run.device, kernels, closing_kernels)
        search = _searches(pair)
        keep, moves = self.options.keep, self.options.steps - FIRST_STEP
        chains = -(-wanted.count // keep)
        steps = Steps(chains * moves, run)

        def work(indices: range) -> HandState:
            seeds = [[wanted.seed, wanted.batch, chain] for chain in indices]
            state = search.run(seeds, steps=self.options.steps, keep=keep, tell=steps)
            return Closer(pair, len(state.pivot)).close(state).state

        states = joined(run_parts(cut(chains, run), work))
        return grasp_set(pair, states[: wanted.count], began, {"chains": chains, "moves": moves})


def _planner(options: GraspitOptions) -> Planner:
    return Graspit(options)


METHOD: Final = Method(
    summary="simulated annealing over eigengrasps with contact energy, then autograsp",
    source="M. T. Ciocarlie and P. K. Allen, Hand posture subspaces for dexterous robotic grasping, IJRR 2009",
    planner=_planner,
    options=GraspitOptions,
    uses=("face_error_m",),
    quick={"steps": FIRST_STEP + 400},
)
