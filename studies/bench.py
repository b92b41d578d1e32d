"""Throughput of the planner over fidelities, batches, threads, hand points and object faces.

The results are a table, JSON and a plot.
"""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any, Final

import warp as wp

from graspd.service.model.cores import available_cores
from graspd.service.model.fidelity import Fidelity
from graspd.service.model.version import PACKAGE_VERSION
from graspd.studies.timing import host_ms, kernel_shares
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd import pairs
from graspd.worker.planners.fast_graspd.batches import Batches
from graspd.worker.planners.fast_graspd.planner import optimise, optimise_batch
from graspd.worker.planners.port import BatchRequest, PlanRequest

#: Largest number of grasps per launch for which host time is reported.
LARGE: Final = 1024

Load = Callable[[float], ObjectModel]
Say = Callable[[str], None]


def bench(
    hand: HandModel,
    load: Load,
    *,
    fidelities: Sequence[Fidelity],
    batches: Sequence[int],
    threads: Sequence[int],
    device: str,
    repeats: int,
    joins: Sequence[int] = (1,),
    say: Say = lambda line: None,
) -> dict[str, Any]:
    """Run each fidelity x batch x joins x threads once.

    Args:
        hand: the hand.
        load: function that loads the object at a fidelity's simplification error bound [m].
        fidelities: fidelities to run.
        batches: grasps per call.
        threads: CPU threads per call; a GPU takes the whole batch at once.
        device: Warp device.
        repeats: timed calls per run, after an untimed one; the median is reported.
        joins: batches in one launch.
        say: receives a line per run.

    Returns:
        `device`, `runs[]` with the keys of the command line's contract, `start` with cold and warm seconds,
        `host_ms_per_grasp` (None on a GPU, where waiting threads spin), `kernels`.
    """
    first = fidelities[0]
    start = _start_times(hand, load(first.face_error_m), first, device)
    runs = []
    for fidelity in fidelities:
        obj = load(fidelity.face_error_m)
        for batch, join, count in product(batches, joins, threads):
            run = _run(hand, obj, fidelity, batch, join, count, device, repeats)
            runs.append(run)
            say(
                f"{fidelity.name:9s} batch {batch:5d} x {join} threads {count}: {run['grasps_per_second']:8.1f} "
                f"grasps/s, {run['ms_per_iteration']:7.2f} ms/iteration"
            )
    pair = pairs.pair_of(hand, load(first.face_error_m), first, device)
    launch = min(LARGE, max(batches) * max(joins))
    host = None if wp.get_device(device).is_cuda else host_ms(hand, load(first.face_error_m), first, launch)
    return {
        "device": device_name(device),
        "hand": hand.name,
        "object": load(first.face_error_m).name,
        "versions": {"graspd": PACKAGE_VERSION, "warp": wp.config.version},
        "start": start,
        "host_ms_per_grasp": None if host is None else round(host, 3),
        "kernels": kernel_shares(pair, first, min(32, max(batches))),
        "runs": runs,
    }


def _start_times(hand: HandModel, obj: ObjectModel, fidelity: Fidelity, device: str) -> dict[str, float]:
    """Return seconds to the first grasp of a fresh process (kernels cached or compiled) and to the next."""
    seconds = []
    for seed in (0, 1):
        began = time.perf_counter()
        optimise_batch(
            hand,
            obj,
            PlanRequest(count=1, fidelity=fidelity, seed=seed, batch=0),
            ExecutionContext(threads=1, device=device),
        )
        seconds.append(round(time.perf_counter() - began, 3))
    return {"first_grasp_s": seconds[0], "next_grasp_s": seconds[1]}


def _run(
    hand: HandModel,
    obj: ObjectModel,
    fidelity: Fidelity,
    batch: int,
    join: int,
    threads: int,
    device: str,
    repeats: int,
) -> dict[str, Any]:
    seconds, run = [], ExecutionContext(threads=threads, device=device)
    for seed in range(repeats + 1):
        began = time.perf_counter()
        asked = [BatchRequest(PlanRequest(batch, fidelity, seed, number), run) for number in range(join)]
        optimise(pairs.pair_of(hand, obj, fidelity, device), Batches(asked, obj), run)
        seconds.append(time.perf_counter() - began)
    typical = median(seconds[1:])
    iterations = fidelity.coarse_iterations + fidelity.fine_iterations
    return {
        "fidelity": fidelity.name,
        "batch": batch,
        "join": join,
        "grasps": batch * join,
        "processes": threads,
        "hand_points": fidelity.fine_points,
        "coarse_points": fidelity.coarse_points,
        "faces": len(obj.faces),
        "iterations": iterations,
        "ms_per_iteration": round(1e3 * typical / iterations, 4),
        "grasps_per_second": round(join * batch / typical, 3),
        "seconds": round(typical, 4),
        "spread": round((max(seconds[1:]) - min(seconds[1:])) / typical, 3),
        "peak_memory_mb": round(_peak_memory_mb(device), 1),
    }


def _peak_memory_mb(device: str) -> float:
    if wp.get_device(device).is_cuda:
        return float(wp.get_mempool_used_mem_high(device)) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def device_name(device: str) -> str:
    """Return the common name of the device."""
    found = wp.get_device(device)
    return str(found.name) if found.is_cuda else f"cpu ({available_cores()} cores)"


def table(result: dict[str, Any]) -> str:
    """Return Markdown: runs, kernel shares, start times."""
    lines = [
        f"{result['hand']} on {result['object']}, {result['device']}, graspd {result['versions']['graspd']}, "
        f"Warp {result['versions']['warp']}",
        "",
        "| fidelity | batch | threads | hand points | faces | its | ms/it | grasps/s | spread | peak MB |",
        "| --- | --: | --: | --: | --: | --: | --: | --: | --: | --: |",
    ]
    lines += [
        f"| {r['fidelity']} | {_batches(r)} | {r['processes']} | {r['coarse_points']}, {r['hand_points']} "
        f"| {r['faces']} | {r['iterations']} | {r['ms_per_iteration']:.2f} | {r['grasps_per_second']:.1f} "
        f"| {100 * r['spread']:.0f} % | {r['peak_memory_mb']:.0f} |"
        for r in result["runs"]
    ]
    for name, phase in result["kernels"].items():
        shares = ", ".join(f"{kernel} {100 * share:.0f} %" for kernel, share in phase["share"].items() if share >= 0.01)
        lines += [
            "",
            f"{name}: {phase['points']} points, {phase['ms_per_iteration']:.2f} ms per iteration on one thread, "
            f"{phase['iterations_to_convergence']:.0f} iterations to convergence "
            f"({shares}); {phase['queries_per_second'] / 1e6:.2f} M distances/s",
        ]
    start = result["start"]
    lines += ["", f"First grasp after {start['first_grasp_s']:.2f} s, the next after {start['next_grasp_s']:.2f} s."]
    return "\n".join(lines)


def _batches(run: dict[str, Any]) -> str:
    """Return the batch, and the number of batches per launch."""
    return str(run["batch"]) if run["join"] == 1 else f"{run['join']} × {run['batch']}"


def write(result: dict[str, Any], folder: Path) -> None:
    """Write bench.json, bench.md and bench.png to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "bench.json").write_text(json.dumps(result, indent=1) + "\n")
    (folder / "bench.md").write_text(table(result) + "\n")
    _plot(result, folder / "bench.png")


def _plot(result: dict[str, Any], path: Path) -> None:
    """Plot grasps per second over the batch, one line per fidelity and thread count."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for key in dict.fromkeys((r["fidelity"], r["processes"]) for r in result["runs"]):
        runs = sorted((r for r in result["runs"] if (r["fidelity"], r["processes"]) == key), key=lambda r: r["grasps"])
        label = f"{key[0]}, {key[1]} thread{'s' if key[1] > 1 else ''}"
        axes.plot([r["grasps"] for r in runs], [r["grasps_per_second"] for r in runs], marker="o", label=label)
    batches = sorted({r["grasps"] for r in result["runs"]})
    axes.set_xscale("log", base=2)
    axes.set_xticks(batches, [str(batch) for batch in batches], minor=False)
    axes.set_xlabel("grasps per call")
    axes.set_ylabel("grasps per second")
    axes.set_ylim(bottom=0)
    axes.set_title(f"{result['hand']} on {result['object']}, {result['device']}", loc="left", fontsize=11)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=150)
