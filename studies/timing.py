"""Timing of an iteration, launch by launch, and of a batch, in kernels and on the host."""

from __future__ import annotations

import time
from typing import Any, Final

import numpy as np
import warp as wp

from graspd.service.model.fidelity import Fidelity
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.pairs import Pair
from graspd.worker.planners.fast_graspd.planner import plan
from graspd.worker.planners.fast_graspd.schedule import coarse_schedule, fine_schedule
from graspd.worker.planners.fast_graspd.starts import sample_starts
from graspd.worker.planners.port import PlanRequest
from graspd.worker.simulation.data import Data, HandState, Schedule
from graspd.worker.simulation.launches import kernel_seconds
from graspd.worker.simulation.model import Model
from graspd.worker.simulation.record import record_iteration

#: Timed iterations, launch by launch, from the middle of a phase.
SAMPLED: Final = 12


def kernel_shares(pair: Pair, fidelity: Fidelity, count: int, *, seed: int = 0) -> dict[str, Any]:
    """Return ms per iteration of both phases, shares of kernels, and closest-point queries per second.

    Args:
        pair: hand and object on a device.
        fidelity: the fidelity.
        count: grasps at once, on one thread.
        seed: seed of the starts.
    """
    state = sample_starts(pair.model(pair.coarse), seed=seed, batch=0, indices=range(count), each=1)
    phases: dict[str, Any] = {}
    for name, side, schedule in (
        ("coarse", pair.coarse, coarse_schedule(fidelity)),
        ("fine", pair.fine, fine_schedule(fidelity)),
    ):
        if len(schedule) < 2:
            continue
        model = pair.model(side)
        data = Data(model, count)
        used = _iterations_used(model, data, state, schedule, fidelity, name)
        times, state = _timed(model, data, state, schedule, fidelity)
        total = sum(times.values())
        phases[name] = {
            "iterations_to_convergence": round(used, 1),
            "ms_per_iteration": round(1e3 * total, 3),
            "points": len(side.points),
            "share": {kernel: round(t / total, 4) for kernel, t in sorted(times.items(), key=lambda item: -item[1])},
            "queries_per_second": round(count * len(side.points) / times["gather"]) if times.get("gather") else None,
        }
    return phases


def _iterations_used(
    model: Model, data: Data, state: HandState, schedule: Schedule, fidelity: Fidelity, phase: str
) -> float:
    """Return the mean iterations until a hand is switched off; the coarse phase always runs to its end."""
    if phase == "coarse" or not fidelity.patience:
        return float(len(schedule))
    data.set_schedule(schedule)
    data.set_state(state)
    launches = record_iteration(model, data, fidelity.optimizer, patience=fidelity.patience)
    alive = 0
    for _ in range(len(schedule)):
        alive += int(data.active.numpy().sum())
        launches.run()
    return alive / len(state.pivot)


def _timed(
    model: Model, data: Data, state: HandState, schedule: Schedule, fidelity: Fidelity
) -> tuple[dict[str, float], HandState]:
    """Return kernel seconds per iteration, medians over `SAMPLED` iterations mid-schedule."""
    data.set_schedule(schedule)
    data.set_state(state)
    launches = record_iteration(model, data, fidelity.optimizer)
    sampled = min(SAMPLED, len(schedule))
    before = (len(schedule) - sampled) // 2
    launches.run(before)
    wp.synchronize_device(data.device)
    found: dict[str, list[float]] = {}
    for _ in range(sampled):
        for name, command in launches.named():
            began = time.perf_counter()
            command.launch()
            wp.synchronize_device(data.device)
            found.setdefault(name, []).append(time.perf_counter() - began)
    launches.run(len(schedule) - before - sampled)
    return {name: float(np.median(values)) for name, values in found.items()}, data.state(len(state.pivot))


def host_ms(hand: HandModel, obj: ObjectModel, fidelity: Fidelity, count: int) -> float:
    """Return host time per candidate on the CPU [ms]: one thread outside the planner's kernels.

    It includes starts, merits, projection, the postures around the grasp, copies and launches.

    Args:
        hand: the hand.
        obj: the object.
        fidelity: the fidelity.
        count: grasps of the batch; an earlier one warms up caches.
    """
    run = ExecutionContext("cpu", threads=1)
    plan(hand, obj, PlanRequest(count, fidelity, seed=1), run)
    with kernel_seconds() as elsewhere:
        began = time.thread_time()
        plan(hand, obj, PlanRequest(count, fidelity, seed=0), run)
        total = time.thread_time() - began
    return 1e3 * (total - sum(elsewhere)) / count
