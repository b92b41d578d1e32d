"""`graspd synth`: grasps in one process, without a queue or a server."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from service.cli import JsonFlag, emit, reporting_errors
from service.domain import BATCH_SIZE, FIDELITIES, Fidelity
from service.errors import InputError
from service.shards import Attribute, json_attribute, write_shard
from worker.certified import joined_columns
from worker.devices import Device
from worker.grasps import GraspSet
from worker.hands.load import hand_from_path
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.objects.prepare import object_from_path
from worker.planners import PLANNERS, planner, synthesize
from worker.planners import Progress as Report
from worker.planners.registry import parsed_options
from worker.quality.gate import passes
from worker.quality.table import measure
from worker.stages.synthesize import postures

Arrays = dict[str, NDArray[Any]]

app = typer.Typer()


@app.command(epilog="graspd synth --hand allegro --object mug -n 32 -o grasps.h5")
@reporting_errors
def synth(
    hand: Annotated[str, typer.Option(help="a URDF, a ZIP with one, or the name of a built-in hand")],
    object_: Annotated[str, typer.Option("--object", help="a mesh (STL, OBJ, PLY, GLB, OFF) or a built-in object")],
    out: Annotated[Path, typer.Option("-o", "--out", help="HDF5 file to write")],
    grasps: Annotated[int, typer.Option("-n", "--grasps", help="number of grasps", min=1, max=100_000)] = 32,
    method: Annotated[
        str, typer.Option(help=f"planner: {', '.join(PLANNERS)}, or one that another package offers")
    ] = "fast_graspd",
    option: Annotated[
        list[str] | None, typer.Option(help="An option of the method, such as steps=20000; several times.")
    ] = None,
    fidelity: Annotated[str, typer.Option(help=f"one of {', '.join(FIDELITIES)}")] = "standard",
    contact_solver: Annotated[str, typer.Option(help="direct, jacobi or gauss_seidel; empty: the fidelity's")] = "",
    seed: Annotated[int, typer.Option(min=0)] = 0,
    friction: Annotated[
        float, typer.Option(help="Coulomb coefficient of the quality metrics", min=0.01, max=3.0)
    ] = 1.0,
    device: Annotated[str, typer.Option(help="cpu, cuda:0 or auto")] = "auto",
    threads: Annotated[int, typer.Option(help="CPU threads; 0: one per core", min=0)] = 0,
    json: JsonFlag = False,
) -> None:
    """Synthesize grasps of one hand on one object into an HDF5 file."""
    if not out.parent.is_dir():
        raise InputError(f"the folder {out.parent} does not exist; create it or choose another --out")
    knobs = chosen_fidelity(fidelity, contact_solver)
    options = parsed_options(option or [])
    planner(method, options)  # a wrong name or option is told before the files are read
    model, obj = hand_from_path(hand), object_from_path(object_, face_error_m=knobs.face_error_m)
    device = Device(device).resolve()
    began = time.perf_counter()
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[rate]}"), TimeElapsedColumn(),
               TimeRemainingColumn())  # fmt: skip
    with Progress(*columns, console=Console(stderr=True), disable=json, transient=True) as bar:
        task = bar.add_task("starting", total=grasps, rate="")

        def report(first: int, count: int) -> Report:
            def tell(done: float, total: float, message: str) -> None:
                ready = first + count * done / total
                rate = f"{ready / max(time.perf_counter() - began, 1e-3):.1f} grasps/s"
                bar.update(task, completed=ready, description=message, rate=rate)

            return tell

        parts = []
        for first in range(0, grasps, BATCH_SIZE):
            count = min(BATCH_SIZE, grasps - first)
            parts.append(
                _batch(
                    model, obj, count=count, method=method, fidelity=knobs, options=options, seed=seed,
                    batch=first // BATCH_SIZE, friction=friction, threads=threads, device=device,
                    progress=report(first, count),
                )
            )  # fmt: skip
    seconds = time.perf_counter() - began
    arrays = joined_columns(parts)
    attributes = _attributes(model, obj, method, knobs, seed, friction, device, seconds)
    out.write_bytes(write_shard("base", arrays, attributes))
    found = summary(arrays, out, seconds)
    if json:
        emit(found)
    else:
        mean = found["mean"]
        typer.echo(
            f"{out}: {found['valid']} of {found['grasps']} grasps valid, {found['grasps_per_second']:.1f} grasps/s; "
            f"mean epsilon {mean['epsilon']:.3f}, contact {mean['contact_area_cm2']:.1f} cm^2, "
            f"penetration {mean['penetration_depth_mm']:.2f} mm"
        )


def chosen_fidelity(name: str, contact_solver: str = "") -> Fidelity:
    """The knobs of a named fidelity, with another contact solver where one is given.

    Raises:
        InputError: unknown fidelity or solver.
    """
    if name not in FIDELITIES:
        raise InputError(f"unknown fidelity {name!r}; choose one of {', '.join(FIDELITIES)}")
    knobs = FIDELITIES[name].model_dump()
    if contact_solver:
        knobs |= {"contact_solver": contact_solver, "name": f"{name}+{contact_solver}"}
    try:
        return Fidelity(**knobs)
    except ValueError:
        raise InputError(f"unknown contact solver {contact_solver!r}; choose direct, jacobi or gauss_seidel") from None


def _batch(
    hand: HandModel, obj: ObjectModel, *, count: int, method: str, fidelity: Fidelity,
    options: dict[str, str], seed: int, batch: int, friction: float, threads: int, device: str, progress: Report,
) -> Arrays:  # fmt: skip
    found: GraspSet = synthesize(
        hand, obj, count=count, method=method, fidelity=fidelity, options=options, seed=seed, batch=batch,
        threads=threads, device=device, progress=progress,
    )  # fmt: skip
    quality = measure(hand, obj, found, friction=friction, threads=threads)
    return {**postures(found), **quality, "quality/valid": passes(quality)}


def _attributes(
    hand: HandModel, obj: ObjectModel, method: str, fidelity: Fidelity, seed: int, friction: float, device: str,
    seconds: float,
) -> dict[str, Attribute]:  # fmt: skip
    return {
        "hand": hand.name, "hand_digest": hand.digest, "object": obj.name, "object_digest": obj.digest,
        "method": method, "fidelity": json_attribute(fidelity.model_dump(mode="json")), "seed": seed, "batch": 0,
        "device": device, "seconds": round(seconds, 4), "mu": friction, "root_link": hand.root_link,
        "joint_names": list(hand.joint_names),
    }  # fmt: skip


def summary(arrays: Arrays, out: Path, seconds: float) -> dict[str, Any]:
    """What a user wants to know first of a base shard."""
    column = int(np.argmin(np.abs(arrays["quality/thresholds_m"] - 0.005)))
    return {
        "file": str(out),
        "grasps": len(arrays["quality/valid"]),
        "valid": int(arrays["quality/valid"].sum()),
        "seconds": round(seconds, 3),
        "grasps_per_second": round(len(arrays["quality/valid"]) / seconds, 2),
        "mean": {
            "epsilon": round(float(arrays["quality/epsilon"][:, column].mean()), 4),
            "contact_area_cm2": round(float(arrays["quality/contact_area_cm2"][:, column].mean()), 2),
            "intersection_volume_cm3": round(float(np.nanmean(arrays["quality/intersection_volume_cm3"])), 4),
            "penetration_depth_mm": round(float(arrays["quality/penetration_depth_mm"].mean()), 3),
        },
    }
