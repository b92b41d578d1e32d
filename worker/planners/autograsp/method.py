"""The planner: a random free start, the palm goes on until something is near, the fingers close until contact."""

from __future__ import annotations

import time
from typing import Final

from pydantic import Field

from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.autograsp import kernels
from worker.planners.autograsp.closing import Closer
from worker.planners.peers import free_starts, grasp_set, ground_of, joined
from worker.planners.port import Method, Options, Planner, Wanted
from worker.planners.threads import Steps, cut, run_parts
from worker.run import Run
from worker.simulation.data import HandState


class AutograspOptions(Options):
    """Options of `autograsp`."""

    standoff_m: float = Field(0.005, ge=0.0, le=0.05, description="gap at which the approach ends [m]")


class Autograsp:
    """See `worker.planners.Planner`."""

    def __init__(self, options: AutograspOptions) -> None:
        self.options = options

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: Wanted, run: Run) -> GraspSet:
        began = time.perf_counter()
        pair = ground_of(hand, obj, run.device, kernels)
        steps = Steps(3 * wanted.count, run)

        def work(indices: range) -> HandState:
            n = len(indices)
            state = free_starts(pair, seed=wanted.seed, batch=wanted.batch, indices=indices)
            steps(n, "starts")
            closer = Closer(pair, n)
            state = closer.approach(state, self.options.standoff_m)
            steps(n, "approach")
            state = closer.close(state).state
            steps(n, "closing")
            return state

        states = run_parts(cut(wanted.count, run), work)
        return grasp_set(pair, joined(states), began, {})


def _planner(options: AutograspOptions) -> Planner:
    return Autograsp(options)


METHOD: Final = Method(
    summary="a random approach, then the fingers close until contact",
    source="A. T. Miller and P. K. Allen, GraspIt!, IEEE Robotics and Automation Magazine 2004",
    planner=_planner,
    options=AutograspOptions,
    uses=("face_error_m",),
)
