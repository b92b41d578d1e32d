"""Quality and speed of grasps on a GPU, compared with the CPU of the same machine; prints Markdown.

usage: python -m benchmarks.on_gpu DATA_DIR [--device cuda:0] [--batches 32 256 1024] [--grasps 64] [--chain 3072]
           [--json OUT] [--page OUT]

DATA_DIR holds hands/ and objects/. For accuracy, both devices plan grasps from the same seeds; the CPU validates
and measures them. Speed is the wall time of each stage of a launch, after an untimed one. The whole chain makes
`--chain` valid grasps as a worker does, with all cores and its pool of processes, after an untimed first batch."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any, Final, TypeVar

import mujoco
import numpy as np
import warp as wp

from benchmarks.success import HANDS
from graspd.service.model.cores import available_cores
from graspd.service.model.domain import BATCH_SIZE, JobOptions
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.matter import MASS_KG
from graspd.service.model.version import PACKAGE_VERSION
from graspd.studies.bench import device_name, kernel_shares
from graspd.worker.batched_generation import validated_batches
from graspd.worker.engines.batch_sizes import batches_per_launch, pool_process_count
from graspd.worker.engines.devices import Device
from graspd.worker.execution_context import ExecutionContext, PrefilterMode
from graspd.worker.generation import ValidatedBatch
from graspd.worker.grasps import join_grasp_sets
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.fast_graspd import planner
from graspd.worker.planners.port import PlanRequest
from graspd.worker.pool.pool import MODULES, Pool
from graspd.worker.quality.table import measure
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.validator import validate

T = TypeVar("T")
OBJECTS: Final = ("025_mug", "006_mustard_bottle", "003_cracker_box", "024_bowl", "077_rubiks_cube", "048_hammer")
#: Seed that was not used to choose any setting.
SEED: Final = 808
FIDELITY: Final = FIDELITIES["standard"]
#: Largest number of grasps per launch that are validated and measured.
VALIDATED: Final = 128
#: Compared metrics (means over the grasps), with their digits in the report.
COLUMNS: Final = {"epsilon": 3, "penetration_depth_mm": 2, "contact_area_cm2": 1}
SHOWN: Final = {"gsr": 2, **COLUMNS}
#: Pairs of the whole chain.
CHAIN: Final = (("Allegro", "025_mug"), ("Barrett", "003_cracker_box"), ("Shadow", "006_mustard_bottle"))
#: Engines of the verdicts: MuJoCo on the CPU alone, or after the prefilter on the GPU.
ENGINES: Final[dict[str, PrefilterMode]] = {"MuJoCo": "off", "prefilter": "on"}


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """Return the result of `work`, and its wall time [s]."""
    began = time.perf_counter()
    made = work()
    return made, time.perf_counter() - began


def quality(hand: HandModel, obj: ObjectModel, device: str, count: int) -> dict[str, float]:
    run = ExecutionContext(device)
    grasps = planner.plan(hand, obj, PlanRequest(count, FIDELITY, SEED), run)
    held = validate(hand, obj, grasps, pieces=decompose(obj)).success == 1
    table = measure(hand, obj, grasps)
    found = {name: float(np.mean(np.asarray(table[f"quality/{name}"], dtype=float))) for name in COLUMNS}
    return {"gsr": float(held.mean()), **found}


def stages(hand: HandModel, obj: ObjectModel, device: str, batch: int) -> dict[str, float]:
    """Return wall ms of each stage per grasp, the held share, and the largest shift of a hand [mm].
    The shift is the distance between the hands of two equal launches."""
    run, wanted = ExecutionContext(device), PlanRequest(batch, FIDELITY, SEED)
    parts = planner.optimise_batch(hand, obj, wanted, run)
    again, planned = timed(lambda: planner.optimise_batch(hand, obj, wanted, run))
    moved = max(
        float(np.abs(one.state.pivot - other.state.pivot).max()) for one, other in zip(parts, again, strict=True)
    )
    planner.grasps_of(hand, obj, parts, 0.0, device=device)
    grasps, around = timed(lambda: planner.grasps_of(hand, obj, again, 0.0, device=device))
    few, pieces = grasps.take(np.arange(min(batch, VALIDATED))), decompose(obj)
    # An untimed call compiles and caches the models of the validator and the kernels of the metrics.
    warm = grasps.take(np.arange(min(batch, 16)))
    validate(hand, obj, warm, pieces=pieces)
    measure(hand, obj, warm)
    verdicts, validated = timed(lambda: validate(hand, obj, few, pieces=pieces))
    _, measured = timed(lambda: measure(hand, obj, few))
    return {
        "planner_ms": 1e3 * planned / batch,
        "postures_ms": 1e3 * around / batch,
        "validation_ms": 1e3 * validated / len(few),
        "quality_ms": 1e3 * measured / len(few),
        "gsr": float((verdicts.success == 1).mean()),
        "moved_mm": 1e3 * moved,
    }


def speed(hand: HandModel, obj: ObjectModel, device: str, batches: Sequence[int]) -> list[dict[str, Any]]:
    return [{"batch": batch, **stages(hand, obj, device, batch)} for batch in batches]


def chain(hand: HandModel, obj: ObjectModel, device: str, engine: str, count: int) -> dict[str, Any]:
    """Return valid grasps per second of the whole chain, their share of candidates, and the share of valid grasps
    that holds at half friction."""
    request = JobOptions(grasps=count, seed=SEED, mass=MASS_KG, rechecks=0)
    join, processes = batches_per_launch(device, None), pool_process_count(device, 0)
    with Pool(processes, MODULES) if processes > 1 else nullcontext() as pool:
        run = ExecutionContext(device, prefilter=ENGINES[engine], pool=pool)

        def make(grasps: int, first: int) -> tuple[list[ValidatedBatch], float]:
            sizes = [min(BATCH_SIZE, grasps - k) for k in range(0, grasps, BATCH_SIZE)]
            return timed(
                lambda: validated_batches(
                    hand, obj, request, sizes=sizes, first=first, join=join, run=run, partial=True
                )
            )

        make(2 * BATCH_SIZE, 1000)
        made, seconds = make(count, 0)
        valid, candidates = sum(len(one.grasps) for one in made), sum(one.candidates for one in made)
        few = join_grasp_sets([one.grasps for one in made]).take(np.arange(min(valid, VALIDATED)))
        hard = validate(hand, obj, few, hard=True, run=replace(run, prefilter="off")).success == 1
    stages_s = {name: sum(one.seconds[name] for one in made) for name in made[0].seconds}
    return {
        "valid_per_s": valid / seconds,
        "valid": valid,
        "share": valid / candidates,
        "hard": float(hard.mean()),
        **{f"{name}_s": value for name, value in stages_s.items()},
        "wall_s": seconds,
    }


def page(result: dict[str, Any]) -> str:
    lines = [
        "# A GPU against the CPU of the same machine",
        "",
        f"    {result['command']}",
        "",
        f"{result['date']}: {result['device']}, {result['cores']} cores, {result['versions']}. Fidelity *standard*, "
        f"seed {SEED}. Times are wall milliseconds per grasp on {result['hands_object']}, in one process. One launch "
        "plans the number of grasps in the second column. Validator and metrics run on the CPU, for at most "
        f"{VALIDATED} grasps. *Moved*: largest distance between the hands of two equal launches.",
        "",
        "| hand | grasps per launch | planner ms | postures ms | candidates/s | validator ms | metrics ms | held | "
        "moved mm "
        "|",
        "| --- | --: | --: | --: | --: | --: | --: | --: | --: |",
    ]
    for hand, rows in result["speed"].items():
        for row in rows:
            each = row["planner_ms"] + row["postures_ms"]
            lines.append(
                f"| {hand} | {row['batch']} | {row['planner_ms']:.2f} | {row['postures_ms']:.3f} | {1e3 / each:.0f} | "
                f"{row['validation_ms']:.1f} | {row['quality_ms']:.1f} | {row['gsr']:.2f} | {row['moved_mm']:.1f} |"
            )
    lines += [
        "",
        "Grasps on GPU / CPU for equal seeds, validated and measured by the same code. Each pair has "
        f"{result['grasps']} grasps, so a share has an error of up to {1.96 * (0.25 / result['grasps']) ** 0.5:.2f}.",
        "",
        "| hand | object | held | ε | penetration mm | contact cm² |",
        "| --- | --- | --: | --: | --: | --: |",
    ]
    for hand, meshes in result["accuracy"].items():
        for mesh, both in meshes.items():
            gpu, cpu = both["gpu"], both["cpu"]
            cells = " | ".join(f"{gpu[key]:.{digits}f} / {cpu[key]:.{digits}f}" for key, digits in SHOWN.items())
            lines.append(f"| {hand} | {mesh} | {cells} |")
    pairs = [both for meshes in result["accuracy"].values() for both in meshes.values()]
    if pairs:
        cells = " | ".join(
            " / ".join(f"{np.mean([both[at][key] for both in pairs]):.{digits}f}" for at in ("gpu", "cpu"))
            for key, digits in SHOWN.items()
        )
        lines.append(f"| all | | {cells} |")
    if result["chain"]:
        lines += [
            "",
            f"Whole chain: {result['chain_grasps']} valid grasps (CPU: a quarter of them) at level standard and "
            "0.1 kg, with metrics. *Valid*: share of the candidates that are valid; *hard*: share of valid grasps that "
            "hold at half friction. On the CPU, rollouts select among a grasp's candidates.",
            "",
            "| hand | object | device | engine | valid/s | valid | hard |",
            "| --- | --- | --- | --- | --: | --: | --: |",
        ]
        lines += [
            f"| {row['hand']} | {row['object']} | {row['device']} | {row['engine']} | {row['valid_per_s']:.0f} | "
            f"{row['share']:.2f} | {row['hard']:.2f} |"
            for row in result["chain"]
        ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--batches", type=int, nargs="+", default=[32, 256, 1024])
    parser.add_argument("--grasps", type=int, default=64, help="grasps of each pair for the comparison of quality")
    parser.add_argument("--chain", type=int, default=3072, help="valid grasps of the whole chain; 0: none")
    parser.add_argument("--json", type=Path, help="file for all figures, rewritten after each step")
    parser.add_argument("--page", type=Path, help="file for the report")
    wanted = parser.parse_args()
    device = Device(wanted.device).resolve()
    result: dict[str, Any] = {
        "command": f"python -m benchmarks.on_gpu DATA --batches {' '.join(map(str, wanted.batches))} "
        f"--grasps {wanted.grasps} --chain {wanted.chain}",
        "date": str(date.today()),
        "device": device_name(device),
        "cores": available_cores(),
        "versions": f"graspd {PACKAGE_VERSION}, Warp {wp.config.version}, MuJoCo {mujoco.__version__}, "
        f"Python {sys.version.split()[0]}",
        "hands_object": f"`{OBJECTS[0]}`",
        "grasps": wanted.grasps,
        "speed": {},
        "accuracy": {},
        "chain": [],
        "chain_grasps": wanted.chain,
    }

    def keep() -> None:
        if wanted.json:
            wanted.json.write_text(json.dumps(result, indent=1) + "\n")
        if wanted.page:
            wanted.page.write_text(page(result))

    hands = {name: hand_from_path(str(wanted.data / "hands" / path)) for name, path in HANDS.items()}
    meshes = {name: object_from_path(str(wanted.data / "objects" / name / "clean.stl")) for name in OBJECTS}
    for name, hand in hands.items():
        result["speed"][name] = speed(hand, meshes[OBJECTS[0]], device, wanted.batches)
        keep()
    for at, engine in ((device, "MuJoCo"), ("cpu", "MuJoCo"), (device, "prefilter")) if wanted.chain else ():
        for name, mesh in CHAIN:
            if engine == "prefilter" and name == "Shadow":
                continue  # the prefilter does not test hands with tendons
            found = chain(hands[name], meshes[mesh], at, engine, wanted.chain // (4 if at == "cpu" else 1))
            result["chain"].append(
                {"hand": name, "object": mesh, "device": at.split(":")[0], "engine": engine, **found}
            )
            keep()
            print(result["chain"][-1], file=sys.stderr, flush=True)  # noqa: T201
    pair = planner.pair_of(hands["Allegro"], meshes[OBJECTS[0]], FIDELITY, device)
    result["kernels"] = {str(n): kernel_shares(pair, FIDELITY, n) for n in wanted.batches}
    for name, hand in hands.items():
        found = result["accuracy"].setdefault(name, {})
        for mesh, obj in meshes.items():
            found[mesh] = {
                which: quality(hand, obj, at, wanted.grasps) for which, at in (("gpu", device), ("cpu", "cpu"))
            }
            keep()
    say(page(result))


if __name__ == "__main__":
    main()
