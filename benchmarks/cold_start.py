"""Time to the first grasps of a command, of a planning process and of a service; prints Markdown.

usage: python -m benchmarks.cold_start CHECKOUT ... [--hand allegro] [--object mug] [--runs 3] [--seeds 0 1 2 3]
           [--no-service | --command]

An untimed run first fills the user's cache, for example with kernels. Wall time depends on other load. Runs of the
checkouts therefore alternate, and the command's table has the least time besides the median. CPU time, of all
processes together, depends little on other load. A seed costs more if its first candidate does not hold."""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final

from benchmarks.chain import environment_of
from benchmarks.service_of import service_of

#: Program that times the parts of a process up to a valid grasp; it uses only names that all checkouts have.
FIRST: Final = """
import json, sys, time
laps, last = {}, time.process_time()
laps["interpreter"] = last
def lap(name):
    global last
    now = time.process_time()
    laps[name], last = now - last, now
import graspd.worker.generation
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.service.model.domain import JobRequest
lap("imports")
hand = hand_from_path(sys.argv[1])
request = JobRequest(hand="h", object="o", grasps=1, fidelity="standard", seed=3)
obj = object_from_path(sys.argv[2], face_error_m=request.knobs.face_error_m)
lap("hand and object")
found = graspd.worker.generation.validated_grasps(hand, obj, request, count=1)
lap("first valid grasp")
graspd.worker.generation.validated_grasps(hand, obj, request, count=1, batch=1)
lap("second valid grasp")
print(json.dumps({"valid": len(found.grasps), "laps": laps}))
"""


def first_grasp(root: Path, hand: str, obj: str) -> dict[str, float]:
    """Return wall time and CPU time of one process, and the CPU time of its parts [s]."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", FIRST, hand, obj],
        cwd=root,
        env=environment_of(root),
        capture_output=True,
        text=True,
        check=False,
    )
    clock, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        sys.exit(f"{root}: {done.stderr[-2000:]}")
    laps = json.loads(done.stdout.splitlines()[-1])["laps"]
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall time": clock, "CPU time": spent, **{f"CPU time: {lap}": value for lap, value in laps.items()}}


def first_command(root: Path, hand: str, obj: str, seed: int) -> dict[str, float]:
    """Return the times of `graspd synth -n 1` [s]; end the program if it finds no valid grasp."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "graspd", "synth", "--hand", hand, "--object", obj, "-n", "1"]
        done = subprocess.run(
            [*command, "--seed", str(seed), "-o", f"{folder}/g.h5", "--json"],
            cwd=root,
            env=environment_of(root),
            capture_output=True,
            text=True,
            check=False,
        )
    clock, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode or json.loads(done.stdout.splitlines()[-1])["valid"] != 1:
        sys.exit(f"{root}: seed {seed}: {done.stderr[-2000:] or 'no valid grasp'}")
    return {
        "clock": clock,
        "processor, user": after.ru_utime - before.ru_utime,
        "processor, system": after.ru_stime - before.ru_stime,
    }


def first_job(root: Path, hand: str, obj: str) -> dict[str, float]:
    """Return the times of a service in an empty folder [s]: start, and first job with 32 valid grasps."""
    with service_of(root) as service:
        spent, began = service.processor_s(), time.perf_counter()
        job = [
            sys.executable,
            "-m",
            "graspd",
            "submit",
            "--hand",
            hand,
            "--object",
            obj,
            "--url",
            service.url,
            "--wait",
        ]
        subprocess.run(job, cwd=root, env=environment_of(root), check=True, capture_output=True)
        clock = time.perf_counter() - began
        return {
            "wall time until a worker waits": service.ready_s,
            "wall time of the job": clock,
            "CPU time of the job": service.processor_s() - spent,
        }


def head(title: str, names: Sequence[str]) -> list[str]:
    """Return a table's head with one column per checkout and, for several, the ratio of first to last."""
    cells = [title, *names, *(["ratio"] if len(names) > 1 else [])]
    return [f"| {' | '.join(cells)} |", "| --- |" + " --: |" * (len(cells) - 1)]


def row(name: str, values: Sequence[float]) -> str:
    cells = [name, *(f"{value:.2f}" for value in values)]
    if len(values) > 1:
        cells.append(f"{values[0] / values[-1]:.2f}" if values[-1] > 0 else "")
    return f"| {' | '.join(cells)} |"


def table(title: str, found: Mapping[str, list[dict[str, float]]]) -> list[str]:
    parts = next(iter(found.values()))[0]
    rows = [row(part, [median(run[part] for run in runs) for runs in found.values()]) for part in parts]
    return [*head(title, list(found)), *rows, ""]


def commands(roots: Sequence[Path], hand: str, obj: str, seeds: Sequence[int], runs: int) -> list[str]:
    """Time `graspd synth -n 1` with each seed; runs of the checkouts alternate."""
    found: dict[tuple[int, Path], list[dict[str, float]]] = {(seed, root): [] for seed in seeds for root in roots}
    for turn in range(runs + 1):
        for (seed, root), timed in found.items():
            one = first_command(root.resolve(), hand, obj, seed)
            if turn:  # the first one fills the caches
                timed.append(one)
    lines = head("`graspd synth -n 1` [s]", [str(root) for root in roots])
    for seed in (*seeds, None):
        mine = [
            [run for (of, at), all_ in found.items() if at == root and seed in (of, None) for run in all_]
            for root in roots
        ]
        name = "all seeds" if seed is None else f"seed {seed}"
        for part, of, told in (
            ("clock", median, "wall time, median"),
            ("clock", min, "wall time, least"),
            ("processor, user", median, "CPU time, user"),
            ("processor, system", median, "CPU time, system"),
        ):
            lines.append(row(f"{name}: {told}", [of(run[part] for run in each) for each in mine]))
    return [*lines, ""]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", nargs="+", type=Path)
    parser.add_argument("--hand", default="allegro")
    parser.add_argument("--object", default="mug")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3], help="seeds of the command")
    parser.add_argument("--no-service", action="store_true", help="only command and process")
    parser.add_argument("--command", action="store_true", help="only the command")
    given = parser.parse_args()
    lines = commands(given.checkouts, given.hand, given.object, given.seeds, given.runs)
    sys.stdout.write("\n".join(lines) + "\n")
    sys.stdout.flush()
    stages: list[tuple[str, Any]] = [] if given.command else [("first valid grasp of a process [s]", first_grasp)]
    if not given.no_service and not given.command:
        stages.append(("first job of a service, 32 valid grasps [s]", first_job))
    for title, measure in stages:
        found: dict[str, list[dict[str, float]]] = {str(root): [] for root in given.checkouts}
        for turn in range(given.runs + 1):
            for root in given.checkouts:
                one = measure(root.resolve(), given.hand, given.object)
                if turn:  # the first one fills the caches
                    found[str(root)].append(one)
        sys.stdout.write("\n".join(table(title, found)) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
