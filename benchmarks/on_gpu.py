"""A GPU against the CPU of the same machine: the grasps must be as good, and how fast they are made; prints Markdown.

usage: python -m benchmarks.on_gpu DATA_DIR [--device cuda:0] [--batches 32 256 1024] [--grasps 64] [--json OUT]

DATA_DIR holds hands/ and objects/. Accuracy: grasps of both devices from the same seeds, judged by the same referee and
measured by the same table, on the CPU. Speed: wall time of each stage of a launch, after one that is not timed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import warp as wp

from benchmarks.success import HANDS
from service.model.domain import FIDELITIES
from worker.engines.devices import Device
from worker.hands.load import hand_from_path
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.objects.prepare import object_from_path
from worker.planners.fast_graspd import planner
from worker.planners.port import Wanted
from worker.quality.referee.decomposition import decompose
from worker.quality.referee.judge import judge
from worker.quality.table import measure
from worker.run import Run
from worker.studies.bench import device_name
from worker.studies.timing import kernel_shares

T = TypeVar("T")
OBJECTS: Final = ("025_mug", "006_mustard_bottle", "003_cracker_box", "024_bowl", "077_rubiks_cube", "048_hammer")
#: Not a seed that any setting was chosen with.
SEED: Final = 808
FIDELITY: Final = FIDELITIES["standard"]
#: Grasps of a launch that are judged and measured.
JUDGED: Final = 128
#: What both devices are compared by, a mean over the grasps each.
COLUMNS: Final = ("epsilon", "penetration_depth_mm", "contact_area_cm2")


def say(line: str) -> None:
    """One line, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """What `work` gives, and its wall time [s]."""
    began = time.perf_counter()
    made = work()
    return made, time.perf_counter() - began


def quality(hand: HandModel, obj: ObjectModel, device: str, count: int) -> dict[str, float]:
    """Success and quality of `count` grasps that were made on a device."""
    run = Run(device)
    grasps = planner.plan(hand, obj, Wanted(count, FIDELITY, SEED), run)
    held = judge(hand, obj, grasps, pieces=decompose(obj)).success == 1
    table = measure(hand, obj, grasps)
    found = {name: float(np.mean(np.asarray(table[f"quality/{name}"], dtype=float))) for name in COLUMNS}
    return {"gsr": float(held.mean()), **found}


def stages(hand: HandModel, obj: ObjectModel, device: str, batch: int) -> dict[str, float]:
    """Wall milliseconds of each stage for one of `batch` grasps, the share that holds, and how far a hand is moved when
    the same launch is made again [mm]."""
    run, wanted = Run(device), Wanted(batch, FIDELITY, SEED)
    parts = planner.optimise_batch(hand, obj, wanted, run)
    again, planned = timed(lambda: planner.optimise_batch(hand, obj, wanted, run))
    moved = max(
        float(np.abs(one.state.pivot - other.state.pivot).max()) for one, other in zip(parts, again, strict=True)
    )
    planner.grasps_of(hand, obj, parts, 0.0, device=device)
    grasps, around = timed(lambda: planner.grasps_of(hand, obj, again, 0.0, device=device))
    few, pieces = grasps.take(np.arange(min(batch, JUDGED))), decompose(obj)
    # Compiled models of the referee and kernels of the table are kept: a first call makes them.
    warm = grasps.take(np.arange(min(batch, 16)))
    judge(hand, obj, warm, pieces=pieces)
    measure(hand, obj, warm)
    verdicts, judged = timed(lambda: judge(hand, obj, few, pieces=pieces))
    _, measured = timed(lambda: measure(hand, obj, few))
    return {
        "planner_ms": 1e3 * planned / batch,
        "postures_ms": 1e3 * around / batch,
        "judge_ms": 1e3 * judged / len(few),
        "quality_ms": 1e3 * measured / len(few),
        "gsr": float((verdicts.success == 1).mean()),
        "moved_mm": 1e3 * moved,
    }


def speed(hand: HandModel, obj: ObjectModel, device: str, batches: Sequence[int]) -> list[dict[str, Any]]:
    """Stages of launches of several sizes."""
    return [{"batch": batch, **stages(hand, obj, device, batch)} for batch in batches]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--batches", type=int, nargs="+", default=[32, 256, 1024])
    parser.add_argument("--grasps", type=int, default=64, help="of each pair whose quality is compared")
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args()
    device = Device(wanted.device).resolve()
    say(f"{date.today()}: {device_name(device)}, Warp {wp.config.version}, Python {sys.version.split()[0]}\n")
    result: dict[str, Any] = {"device": device_name(device), "speed": {}, "accuracy": {}}
    hands = {name: hand_from_path(str(wanted.data / "hands" / path)) for name, path in HANDS.items()}
    meshes = {name: object_from_path(str(wanted.data / "objects" / name / "clean.stl")) for name in OBJECTS}
    for name, hand in hands.items():
        obj = meshes["025_mug"]
        rows = speed(hand, obj, device, wanted.batches)
        result["speed"][name] = rows
        for row in rows:
            say(f"{name} {json.dumps({key: round(value, 4) for key, value in row.items()})}")
    pair = planner.pair_of(hands["Allegro"], meshes["025_mug"], FIDELITY, device)
    result["kernels"] = {str(n): kernel_shares(pair, FIDELITY, n) for n in wanted.batches}
    say(json.dumps(result["kernels"]))
    for name, hand in hands.items():
        for mesh, obj in meshes.items():
            both = {at: quality(hand, obj, at, wanted.grasps) for at in (device, "cpu")}
            result["accuracy"].setdefault(name, {})[mesh] = both
            cells = " | ".join(f"{both[device][key]:.3f} / {both['cpu'][key]:.3f}" for key in both["cpu"])
            say(f"| {name} | {mesh} | {cells} |")
            if wanted.json:
                wanted.json.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
