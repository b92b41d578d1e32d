"""Planner throughput by fidelity, batch and threads, with times of kernels and of the host."""

import json
import resource
import time
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np
import warp as wp

from graspd.service.model.cores import available_cores
from graspd.service.model.fidelity import Fidelity
from graspd.service.model.version import PACKAGE_VERSION
from graspd.studies.figures import TEMPLATES
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.batches import Batches
from graspd.worker.planners.fast_graspd.pairs import Pair, pair_of
from graspd.worker.planners.fast_graspd.planner import optimise, optimise_batch, plan
from graspd.worker.planners.fast_graspd.schedule import coarse_schedule, fine_schedule
from graspd.worker.planners.fast_graspd.starts import sample_starts
from graspd.worker.planners.port import BatchRequest, PlanRequest
from graspd.worker.simulation.data import Data, HandState, Schedule
from graspd.worker.simulation.launches import kernel_seconds
from graspd.worker.simulation.model import Model
from graspd.worker.simulation.record import record_iteration

LARGE: Final = 1024  # largest number of grasps in the measurement of host time


def bench(
    hand: HandModel,
    load: Callable[[float], ObjectModel],
    *,
    fidelities: Sequence[Fidelity],
    batches: Sequence[int],
    threads: Sequence[int],
    device: str,
    repeats: int,
    joins: Sequence[int],
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Time each combination of fidelity, batch, joins and threads; `say` receives a line per combination.
    `load` loads the object at an error bound of its mesh [m]; `joins` are numbers of batches per launch. Times are
    medians of `repeats` calls, after an untimed call. A GPU ignores `threads`. `host_ms_per_grasp` is None on a GPU,
    because waiting threads are busy there."""
    first = fidelities[0]
    nominal = load(first.face_error_m)
    # The first grasp of a process loads or compiles kernels.
    seconds = []
    for seed in (0, 1):
        began = time.perf_counter()
        optimise_batch(hand, nominal, PlanRequest(1, first, seed), ExecutionContext(device, threads=1))
        seconds.append(round(time.perf_counter() - began, 3))
    start = {"first_grasp_s": seconds[0], "next_grasp_s": seconds[1]}
    runs = []
    for fidelity in fidelities:
        obj = load(fidelity.face_error_m)
        for batch, join, count in product(batches, joins, threads):
            run = _time_combination(hand, obj, fidelity, batch, join, ExecutionContext(device, count), repeats)
            runs.append(run)
            say(
                f"{fidelity.name:9s} batch {batch:5d} x {join} threads {count}: {run['grasps_per_second']:8.1f} "
                f"grasps/s, {run['ms_per_iteration']:7.2f} ms/iteration"
            )
    host = None
    if not wp.get_device(device).is_cuda:
        host = round(measure_host_ms(hand, nominal, first, min(LARGE, max(batches) * max(joins))), 3)
    return {
        "device": device_name(device),
        "hand": hand.name,
        "object": nominal.name,
        "versions": {"graspd": PACKAGE_VERSION, "warp": wp.config.version},
        "start": start,
        "host_ms_per_grasp": host,
        "kernels": kernel_shares(pair_of(hand, nominal, first, device), first, min(32, max(batches))),
        "runs": runs,
    }


def _time_combination(
    hand: HandModel, obj: ObjectModel, fidelity: Fidelity, batch: int, join: int, run: ExecutionContext, repeats: int
) -> dict[str, Any]:
    seconds = []
    for seed in range(repeats + 1):
        began = time.perf_counter()
        asked = [BatchRequest(PlanRequest(batch, fidelity, seed, number), run) for number in range(join)]
        optimise(pair_of(hand, obj, fidelity, run.device), Batches(asked, obj), run)
        seconds.append(time.perf_counter() - began)
    typical = median(seconds[1:])
    iterations = fidelity.coarse_iterations + fidelity.fine_iterations
    return {
        "fidelity": fidelity.name,
        "batch": batch,
        "join": join,
        "grasps": batch * join,
        "processes": run.threads,
        "hand_points": fidelity.fine_points,
        "coarse_points": fidelity.coarse_points,
        "faces": len(obj.faces),
        "iterations": iterations,
        "ms_per_iteration": round(1e3 * typical / iterations, 4),
        "grasps_per_second": round(join * batch / typical, 3),
        "seconds": round(typical, 4),
        "spread": round((max(seconds[1:]) - min(seconds[1:])) / typical, 3),
        "peak_memory_mb": round(_peak_memory_mb(run.device), 1),
    }


def _peak_memory_mb(device: str) -> float:
    if wp.get_device(device).is_cuda:
        return float(wp.get_mempool_used_mem_high(device)) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


SAMPLED: Final = 12  # number of iterations that are timed launch by launch, in the middle of a phase


def kernel_shares(pair: Pair, fidelity: Fidelity, count: int) -> dict[str, Any]:
    """Return time per iteration [ms], shares of kernels and queries per second of each phase.
    They are measured with `count` grasps."""
    state = sample_starts(pair.model(pair.coarse), seed=0, batch=0, indices=range(count), each=1)
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
        times, state = _time_kernels(model, data, state, schedule, fidelity)
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
    """Return the mean number of iterations until a hand stops; the coarse phase always runs to its end."""
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


def _time_kernels(
    model: Model, data: Data, state: HandState, schedule: Schedule, fidelity: Fidelity
) -> tuple[dict[str, float], HandState]:
    """Return each kernel's median seconds over `SAMPLED` middle iterations, and the hands at the end."""
    data.set_schedule(schedule)
    data.set_state(state)
    launches = record_iteration(model, data, fidelity.optimizer)
    sampled = min(SAMPLED, len(schedule))
    before = (len(schedule) - sampled) // 2
    launches.run(before)
    wp.synchronize_device(data.device)
    found: dict[str, list[float]] = {}
    for _ in range(sampled):
        for name, command in launches.named_commands():
            began = time.perf_counter()
            command.launch()
            wp.synchronize_device(data.device)
            found.setdefault(name, []).append(time.perf_counter() - began)
    launches.run(len(schedule) - before - sampled)
    return {name: float(np.median(values)) for name, values in found.items()}, data.state(len(state.pivot))


def measure_host_ms(hand: HandModel, obj: ObjectModel, fidelity: Fidelity, count: int) -> float:
    """Return host time per candidate [ms], with full caches.
    It is the time of one CPU thread outside the planner's kernels."""
    run = ExecutionContext("cpu", threads=1)
    plan(hand, obj, PlanRequest(count, fidelity, seed=1), run)
    with kernel_seconds() as elsewhere:
        began = time.thread_time()
        plan(hand, obj, PlanRequest(count, fidelity, seed=0), run)
        total = time.thread_time() - began
    return 1e3 * (total - sum(elsewhere)) / count


def device_name(device: str) -> str:
    found = wp.get_device(device)
    return str(found.name) if found.is_cuda else f"cpu ({available_cores()} cores)"


def clock_of(device: str) -> Callable[[], float]:
    """Return a clock: core-seconds of all threads on a CPU, wall clock on a GPU.
    Other load hardly matters for core-seconds."""
    return time.process_time if device == "cpu" else time.perf_counter


def results_table(result: dict[str, Any]) -> str:
    """Return the result of `bench` in Markdown."""
    return TEMPLATES.get_template("bench.md.j2").render(result).rstrip("\n")


def write(result: dict[str, Any], folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "bench.json").write_text(json.dumps(result, indent=1) + "\n")
    (folder / "bench.md").write_text(results_table(result) + "\n")
