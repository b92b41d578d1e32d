"""Agreement of the prefilter with level standard, and its speed.

usage: python -m benchmarks.prefilter DATA_DIR [--work DIR] [--device cuda:0] [--hands ...] [--objects ...]
           [--grasps 48] [--speed 256 1024] [--worlds 256 1024] [--out docs/results/prefilter]
DATA_DIR holds hands/ and objects/. The prefilter and level standard validate the same candidates; agreement refers to
the prefilter's clear verdicts. `--speed N` measures the time for N grasps in pools of `--worlds`. The grasps are those
of the first cell of each hand, repeated with shifts of up to 0.1 mm. Prints Markdown; `--out` receives .json and .md.
Interrupted runs resume (see cells.py), but the prefilter's verdicts are not cached."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cells import Cell, cell_parser, cells, write_json
from graspd.worker.engines.devices import Device, cpu_name
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.quality.intervals import wilson_interval
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import MujocoOptions, build_scene
from graspd.worker.validation.prefilter.prefilter import PrefilterOutcomes, WorldPool, mujoco_warp

OBJECTS = ("005_tomato_soup_can", "025_mug", "011_banana", "035_power_drill")
#: Largest random shift of repeated grasps in speed tests [m].
JITTER_M = 1e-4


def pool_of(cell: Cell, device: str, worlds: int) -> WorldPool:
    return WorldPool(build_scene(cell.hand, cell.obj, decompose(cell.obj), MujocoOptions()), device, worlds)


def agreement(cell: Cell, device: str) -> dict[str, Any]:
    standard = cell.verdicts("standard", False)
    grasps, held = cell.grasps, np.array(standard["success"]) == 1
    cpu = time.process_time()
    found = pool_of(cell, device, len(grasps)).validate(grasps)
    cpu = time.process_time() - cpu
    holds, fails = found.clearly_held, found.clearly_failed
    return {
        "hand": cell.hand_name,
        "object": cell.object_name,
        "n": len(grasps),
        "held": int(held.sum()),
        "same": int((found.held == held).sum()),
        "clear_holds": int(holds.sum()),
        "clear_failures": int(fails.sum()),
        "false_accepts": int((holds & ~held).sum()),
        "false_refusals": int((fails & held).sum()),
        "overflows": int(found.overflow.sum()),
        "ticks": int(found.ticks.sum()),
        "cpu_seconds": round(cpu, 2),
        "standard_cpu_seconds": round(standard["cpu_seconds"], 2),
    }


def together(rows: list[dict[str, Any]]) -> dict[str, Any]:
    total = {key: sum(row[key] for row in rows) for key in rows[0] if key not in ("hand", "object")}
    clear = total["clear_holds"] + total["clear_failures"]
    wrong = total["false_accepts"] + total["false_refusals"]
    low, high = wilson_interval(clear - wrong, clear)
    return total | {
        "hand": rows[0]["hand"] if len({row["hand"] for row in rows}) == 1 else "all",
        "clear_share": clear / total["n"],
        "agreement_without_band": total["same"] / total["n"],
        "agreement": (clear - wrong) / clear,
        "interval": [round(low, 4), round(high, 4)],
    }


def many(grasps: GraspSet, count: int) -> GraspSet:
    """Return `count` grasps: copies of these, each with a small shift."""
    rng, rows = np.random.default_rng(7), np.arange(count) % len(grasps)
    shift = np.zeros((count, 7))
    shift[len(grasps) :, :3] = rng.uniform(-JITTER_M, JITTER_M, (max(0, count - len(grasps)), 3))

    def moved(part: Posture) -> Posture:
        return Posture(part.hand_pose[rows] + shift, part.joint_positions[rows])

    return GraspSet(moved(grasps.grasp), moved(grasps.pregrasp), moved(grasps.squeeze), grasps.stability_loss[rows])


def speeds(cell: Cell, device: str, counts: list[int], worlds: list[int]) -> Iterator[dict[str, Any]]:
    """Yield grasps per second with loaded kernels, and separately the time to build the pool."""
    for size in worlds:
        began = time.perf_counter()
        pool = pool_of(cell, device, size)
        pool.validate(many(cell.grasps, min(size, 32)))
        made = time.perf_counter() - began
        for count in counts:
            grasps = many(cell.grasps, count)
            pool.validate(grasps)  # prepares arrays and graph for this number of grasps
            began = time.perf_counter()
            found: PrefilterOutcomes = pool.validate(grasps)
            seconds = time.perf_counter() - began
            yield {
                "hand": cell.hand_name,
                "object": cell.object_name,
                "device": device,
                "worlds": size,
                "grasps": count,
                "seconds": round(seconds, 3),
                "grasps_per_second": round(count / seconds, 1),
                "world_steps_per_second": round(10 * float(found.ticks.sum()) / seconds),
                "launches": pool.launches,
                "seconds_per_launch": round(seconds / max(1, pool.launches), 5),
                "overflows": int(found.overflow.sum()),
                "held": int(found.held.sum()),
                "clear": int((found.clearly_held | found.clearly_failed).sum()),
                "seconds_to_make": round(made, 2),
            }


ABOUT = """\
Verdicts of the prefilter, compared with level *standard*. A verdict is clear if its margin to the
limits is large and the memory of contacts did not overflow."""
AGREEMENT = (
    "| hand | grasps | held at level standard | agreement of all verdicts | clear verdicts "
    "| agreement of clear verdicts (95 %) | false accepts, false rejections | overflows |\n| --- | --: | --: | --: | "
    "--: | --- | --- | --: |"
)
SPEED = (
    "| hand | object | worlds | grasps | grasps/s | world steps/s | ms per launch |\n"
    "| --- | --- | --: | --: | --: | --: | --: |"
)


def agreement_line(r: dict[str, Any]) -> str:
    low, high = (f"{100 * bound:.1f}" for bound in r["interval"])
    return (
        f"| {r['hand']} | {r['n']} | {r['held'] / r['n']:.2f} | {100 * r['agreement_without_band']:.1f} % "
        f"| {100 * r['clear_share']:.1f} % | {100 * r['agreement']:.2f} % ({low} to {high}) "
        f"| {r['false_accepts']}, {r['false_refusals']} | {r['overflows']} |"
    )


def speed_line(r: dict[str, Any]) -> str:
    return (
        f"| {r['hand']} | {r['object']} | {r['worlds']} | {r['grasps']} | {r['grasps_per_second']:.0f} "
        f"| {r['world_steps_per_second']} | {1e3 * r['seconds_per_launch']:.2f} |"
    )


def main() -> None:
    parser = cell_parser(__doc__, objects=list(OBJECTS), grasps=48)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--speed", nargs="*", type=int, default=[])
    parser.add_argument("--worlds", nargs="+", type=int, default=[256])
    parser.add_argument("--no-agreement", action="store_true", help="speed alone")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    device = Device(args.device)
    used = device.resolve()
    rows: list[dict[str, Any]] = []
    timed: list[dict[str, Any]] = []
    text: list[str] = []
    for hand in args.hands:
        of_hand = list(cells(args.data, args.work, hand, args.grasps, args.objects))
        for cell in [] if args.no_agreement else of_hand:
            rows.append(agreement(cell, used))
            sys.stderr.write(f"{rows[-1]}\n")
        for row in speeds(of_hand[0], used, args.speed, args.worlds) if args.speed else ():
            timed.append(row)
            sys.stderr.write(f"{row}\n")
    totals = [together([row for row in rows if row["hand"] == hand]) for hand in args.hands] if rows else []
    if rows:
        text += [AGREEMENT, *map(agreement_line, [*totals, *([together(rows)] if len(totals) > 1 else [])]), ""]
    if timed:
        text += [SPEED, *map(speed_line, timed), ""]
    engine = f"mujoco_warp {mujoco_warp().__version__} on {device.name if used != 'cpu' else cpu_name()}"
    sys.stdout.write("\n".join([f"{engine}", "", *text]))
    if args.out:
        write_json(args.out.with_suffix(".json"), {"engine": engine, "cells": rows, "hands": totals, "speed": timed})
        args.out.with_suffix(".md").write_text(
            "\n".join([f"# The prefilter\n\n{ABOUT} Engine: {engine}.\n", *text]).rstrip() + "\n"
        )


if __name__ == "__main__":
    main()
