"""The planner: starts, coarse phase, fine phase, projection. A batch is cut into one part per CPU thread."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from service.model.domain import Fidelity
from worker.grasps import GraspSet, joined
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.fast_graspd.candidates import Seated, tried, with_postures
from worker.planners.fast_graspd.pairs import Pair, pair_of
from worker.planners.fast_graspd.scene_starts import sample_scene_starts
from worker.planners.fast_graspd.schedule import DILATION, coarse_schedule, fine_schedule, in_scene
from worker.planners.fast_graspd.selection import best_of_each, merits, ranked
from worker.planners.fast_graspd.starts import Probe, sample_starts
from worker.planners.fast_graspd.withdrawal import hindrance
from worker.planners.port import Trial, Wanted
from worker.planners.threads import Steps, cut, run_parts
from worker.run import Run
from worker.simulation.data import Data
from worker.simulation.launches import Launches
from worker.simulation.model import Model
from worker.simulation.obstacles import DeviceObstacles
from worker.simulation.projection import Projection, ProjectionOptions
from worker.simulation.state import HandState
from worker.simulation.surroundings import Placed

Floats = NDArray[np.float64]

#: Iterations between two looks at cancellation.
CHUNK: Final = 10
#: Fewest grasps worth a thread of their own.
PART: Final = 4


@dataclass
class Part:
    """Grasps `indices` of a batch, worked on by one thread."""

    indices: range
    state: HandState | None = None
    loss: Floats | None = None
    curve: list[float] | None = None
    grasps: GraspSet | None = None
    """With the postures around them, where a trial needed these."""


def plan(hand: HandModel, obj: ObjectModel, wanted: Wanted, run: Run) -> GraspSet:
    """See `worker.planners.Planner`."""
    began = time.perf_counter()
    parts = optimise_batch(hand, obj, wanted, run)
    return grasps_of(hand, obj, parts, time.perf_counter() - began, wanted.placed)


def optimise_batch(hand: HandModel, obj: ObjectModel, wanted: Wanted, run: Run) -> list[Part]:
    """Starts, optimisation and projection of a batch, without the postures around each grasp."""
    return optimise_pair(pair_of(hand, obj, wanted.fidelity, run.device), wanted, run)


def optimise_pair(pair: Pair, wanted: Wanted, run: Run) -> list[Part]:
    """The same for a pair that is on `run.device` already, and need not be as the fidelity would make it."""
    if wanted.placed is not None:
        wanted = replace(wanted, fidelity=in_scene(wanted.fidelity))
    steps = Steps(wanted.count * (_hands(wanted.fidelity) + 1), run)

    def work(indices: range) -> Part:
        part = Part(indices)
        _work(pair, part, wanted, steps)
        return part

    return run_parts(cut(wanted.count, run, least=PART), work)


def _hands(fidelity: Fidelity) -> int:
    """Hand iterations that one grasp costs."""
    return fidelity.starts * fidelity.coarse_iterations + _finalists(fidelity) * fidelity.fine_iterations


def _finalists(fidelity: Fidelity) -> int:
    """Hands of a grasp that enter the fine phase: no more than set out."""
    return min(fidelity.finalists, fidelity.starts)


def _work(pair: Pair, part: Part, wanted: Wanted, steps: Steps) -> None:
    fidelity, rows = wanted.fidelity, slice(part.indices.start, part.indices.stop)
    placed = wanted.placed.take(rows) if wanted.placed else None
    n, hand, obj = len(part.indices), pair.hand.model, pair.fine.obj.model
    finalists = _finalists(fidelity)
    obstacles = _obstacles(pair, placed)
    which: dict[str, Any] = {"seed": wanted.seed, "batch": wanted.batch, "indices": part.indices}
    which["each"] = fidelity.starts
    coarse, fine = pair.model(pair.coarse, obstacles), pair.model(pair.fine, obstacles)
    state = sample_starts(coarse, **which) if placed is None else sample_scene_starts(coarse, placed=placed, **which)
    touch = Probe(coarse, len(state.pivot)).nearest(state) / DILATION if fidelity.dilation == "touch" else None
    steps(n, "starts")
    part.curve = []
    data = _in_scenes(Data(coarse, n * fidelity.starts), placed, fidelity.starts)
    data.set_schedule(coarse_schedule(fidelity))
    data.set_state(state, dilation=touch)
    # The coarse phase changes its own task as the dilation shrinks: nothing has converged before its end.
    launches = pair.iteration(coarse, data, fidelity.optimizer, patience=0)
    state = _descend(launches, data, n * fidelity.starts, fidelity.coarse_iterations, steps, "coarse", part.curve)
    losses = _losses(data, state)
    order = np.arange(n * fidelity.starts).reshape(n, -1)
    if finalists < fidelity.starts:
        merit = merits(hand, obj, state, losses)
        if placed is not None:
            merit += hindrance(coarse, state, placed.take(np.repeat(np.arange(n), fidelity.starts)))
        order = ranked(merit, n)[:, :finalists]
    seats = _Seats(pair, fine, fidelity, state, losses, placed, steps, part.curve)
    if finalists > 1 and placed is not None and wanted.trial is not None:
        taken = tried(hand, obj, order, seats.seated, placed, _stoppable(wanted.trial, steps))
        part.state, part.loss, part.grasps = taken.state, taken.losses, taken.joined()
        return
    seated = seats.seated(np.sort(order, axis=1), np.arange(n))
    winners = best_of_each(seated.merit, n, 1) if finalists > 1 else np.arange(n)
    part.state, part.loss = seated.state[winners], seated.losses[winners]


@dataclass
class _Seats:
    """The fine phase and the projection of hands that set out."""

    pair: Pair
    fine: Model
    fidelity: Fidelity
    state: HandState
    losses: Floats
    placed: Placed | None
    steps: Steps
    curve: list[float]
    """Goes on with the loss of the first that are seated."""

    def seated(self, rows: NDArray[np.intp], which: NDArray[np.intp]) -> Seated:
        """Hands `rows` (k, each) of the grasps `which` (k,) of this part."""
        fidelity, flat = self.fidelity, rows.ravel()
        state, losses = self.state[flat], self.losses[flat]
        placed = self.placed.take(which) if self.placed is not None else None
        data = _in_scenes(Data(self.fine, len(flat)), placed, rows.shape[1])
        data.set_schedule(fine_schedule(fidelity))
        data.set_state(state)
        launches = self.pair.iteration(self.fine, data, fidelity.optimizer, patience=fidelity.patience)
        curve, self.curve = self.curve, []
        state = _descend(launches, data, len(flat), fidelity.fine_iterations, self.steps, "fine", curve)
        if fidelity.fine_iterations:
            losses = _losses(data, state)
        # Without iterations this only tells how deep each hand is.
        state, depths = Projection(self.fine, data, ProjectionOptions()).run(state, fidelity.polish_iterations)
        if rows.shape[1] == 1:
            return Seated(state, losses, np.zeros(len(flat)))
        hand, obj = self.pair.hand.model, self.pair.fine.obj.model
        return Seated(state, losses, merits(hand, obj, state, losses, depths))


def _stoppable(trial: Trial, steps: Steps) -> Trial:
    def asked(grasps: GraspSet, placed: Placed) -> Floats:
        steps(0, "trial")
        return trial(grasps, placed)

    return asked


def _obstacles(pair: Pair, placed: Placed | None) -> DeviceObstacles | None:
    if placed is None:
        return None
    centre = pair.fine.obj.model.centre_of_mass
    return DeviceObstacles.create(pair.hand.model, placed.scenes, centre, pair.hand.device)


def _in_scenes(data: Data, placed: Placed | None, each: int) -> Data:
    """The data with the scene of every hand, `each` hands a grasp."""
    if placed is not None:
        data.set_scenes(np.repeat(placed.index, each))
    return data


def _losses(data: Data, state: HandState) -> Floats:
    """L_stable (n,) of the last iteration."""
    return data.loss.numpy()[: len(state.pivot)].mean(axis=1).astype(float)


def _descend(
    launches: Launches, data: Data, n: int, iterations: int, steps: Steps, name: str, curve: list[float]
) -> HandState:
    """The first n hands after so many iterations."""
    done = 0
    while done < iterations:
        chunk = min(CHUNK, iterations - done)
        launches.run(chunk)
        done += chunk
        steps(n * chunk, name)
        if not wp.get_device(data.device).is_cuda:
            curve.append(float(data.loss.numpy()[:n].mean()))
    return data.state(n)


def grasps_of(
    hand: HandModel, obj: ObjectModel, parts: list[Part], seconds: float, placed: Placed | None = None
) -> GraspSet:
    """The parts of a batch as grasps with the postures around them."""
    curves = [part.curve for part in parts if part.curve]
    curve = np.mean(curves, axis=0).round(5).tolist() if curves else []
    known = [part.grasps for part in parts if part.grasps is not None]
    if len(known) == len(parts):
        grasps = joined(known)
    else:
        states = [part.state for part in parts if part.state is not None]
        state = HandState(*(np.concatenate([getattr(s, name) for s in states]) for name in ("pivot", "rotation", "q")))
        loss = np.concatenate([part.loss for part in parts if part.loss is not None])
        grasps = with_postures(hand, obj, state, loss, placed)
    return replace(grasps, seconds=seconds, info={"loss_curve": curve, "chunk": CHUNK})
