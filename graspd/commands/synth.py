"""`graspd synth`: the grasps of a job in one process, without a queue or a server."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Final, get_args

import typer
from pydantic import ValidationError

from graspd.service.cli import (
    JsonFlag,
    emit,
    engine_settings,
    fail,
    plain_console,
    reporting_errors,
    told_to_stop,
    write_output,
)
from graspd.service.model.base import refusal
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError, TaskCancelled, one_of
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.metrics import DIRECTION_CELLS, MIN_DISTANCE_M, ROBUST_MODELS
from graspd.service.model.scene_spec import MOST_SCENES, parse_scene
from graspd.service.store.asset_options import (
    AllowOpenOption,
    CompoundOption,
    DensityOption,
    KeepLargestOption,
    MassOption,
    MinPayloadOption,
    ObjectFrictionOption,
    ScaleToOption,
    ShakeOption,
    UnitsOption,
    object_options,
)
from graspd.service.store.shards import write_shard
from graspd.worker.execution_context import Progress as Report
from graspd.worker.files.provenance import id_of_columns
from graspd.worker.files.synthesis import chosen_fidelity, synthesized
from graspd.worker.planners import PLANNERS
from graspd.worker.planners.registry import of_this_machine, parsed_options
from graspd.worker.scenes.rest import rolling_note
from graspd.worker.validation.key import Level

app = typer.Typer()
#: Exit code of a run that found fewer grasps than it was asked for.
FEWER: Final = 3


@app.command(epilog="graspd synth --hand allegro --object mug -n 32 -o grasps.h5")
@reporting_errors
def synth(
    hand: Annotated[str, typer.Option(help="a URDF, a ZIP with one, or the name of a built-in hand")],
    object_: Annotated[str, typer.Option("--object", help="a mesh (STL, OBJ, PLY, GLB, OFF) or a built-in object")],
    out: Annotated[Path, typer.Option("-o", "--out", help="HDF5 file to write")],
    grasps: Annotated[int, typer.Option("-n", "--grasps", help="number of grasps", min=1, max=100_000)] = 32,
    want: Annotated[str, typer.Option(help="valid: that many valid grasps; candidates: of any kind.")] = "valid",
    budget: Annotated[float, typer.Option(help="Grasps tried for each one wanted, at most.", min=1.0, max=100.0)] = 4.0,
    validation: Annotated[
        str,
        typer.Option(
            help="dexgraspbench, standard, fast; none: nothing is validated, grasps are feasible, never valid."
        ),
    ] = "standard",
    robust: Annotated[
        float, typer.Option(help="Share of models around the nominal one that a grasp must hold in.", min=0, max=1)
    ] = 0.0,
    robust_models: Annotated[
        int,
        typer.Option(
            help=f"Models that each valid grasp is validated in; 0: {ROBUST_MODELS} with --robust.", min=0, max=64
        ),
    ] = 0,
    method: Annotated[
        str, typer.Option(help=f"planner: {', '.join(PLANNERS)}, or one that another package offers")
    ] = "fast_graspd",
    option: Annotated[
        list[str] | None, typer.Option(help="An option of the method, such as steps=20000; several times.")
    ] = None,
    fidelity: Annotated[str, typer.Option(help=f"one of {', '.join(FIDELITIES)}")] = "standard",
    contact_solver: Annotated[str, typer.Option(help="direct, jacobi or gauss_seidel; empty: the fidelity's")] = "",
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same grasps.")] = 0,
    friction: Annotated[
        float, typer.Option(help="Coulomb coefficient of the quality metrics", min=0.01, max=3.0)
    ] = 1.0,
    mass: MassOption = None,
    density: DensityOption = None,
    object_friction: ObjectFrictionOption = None,
    payload: Annotated[
        bool | None,
        typer.Option(
            help="Measure the heaviest mass that each valid grasp lifts; default: in scenes where a mass is said."
        ),
    ] = None,
    min_payload: MinPayloadOption = 0.0,
    shake: ShakeOption = False,
    units: UnitsOption = None,
    scale_to: ScaleToOption = None,
    keep_largest: KeepLargestOption = False,
    compound: CompoundOption = False,
    allow_open: AllowOpenOption = False,
    device: Annotated[str, typer.Option(help="cpu, cuda:0 or auto")] = "auto",
    threads: Annotated[int, typer.Option(help="CPU threads; 0: one per core", min=0)] = 0,
    min_distance: Annotated[
        float,
        typer.Option(
            min=0, max=0.1, help="No two grasps are nearer [m]: mean distance of the same points of the hand; 0: any."
        ),
    ] = MIN_DISTANCE_M,
    join: Annotated[str, typer.Option(help="Batches of 32 that are planned in one launch, or auto.")] = "auto",
    scene: Annotated[
        str, typer.Option(help="Where the grasps are used: free, table, bin, shelf, or a JSON or YAML file.")
    ] = "free",
    scenes: Annotated[int, typer.Option(help="Scenes that the grasps are shared out to.", min=1, max=MOST_SCENES)] = 4,
    faces: Annotated[str, typer.Option(help="drawn: as drops fall; all: a scene for each stable face.")] = "drawn",
    touch: Annotated[
        float | None,
        typer.Option(
            help="mm that fingertips keep from supports: 2 as the hand; 0 (default): they touch; to -1: press."
        ),
    ] = None,
    with_: Annotated[
        list[str] | None, typer.Option("--with", help="Another object on the table: file or built-in; up to eight.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Make grasps of one hand on one object as a job does, validated and measured, into an HDF5 file.

    In a scene a grasp is valid if it comes, closes and lifts without touching anything else and holds what it lifts.
    Exit code 3: fewer grasps were found than asked. Ctrl-C keeps those that are validated.
    """
    if not out.parent.is_dir():
        raise InputError(f"the folder {out.parent} does not exist; create it or choose another --out")
    if out.is_dir():
        raise InputError(f"{out} is a folder; name a file in it, such as --out {out / 'grasps.h5'}")
    if payload is None:
        payload = scene != "free" and validation != "none" and (mass is not None or density is not None)
    matter = {
        "mass": mass,
        "density": density,
        "object_friction": object_friction,
        "payload": payload,
        "min_payload": min_payload,
        "shake": shake,
    }
    request = _request(want, budget, validation, robust, robust_models, matter).model_copy(
        update={
            "grasps": grasps,
            "method": method,
            "seed": seed,
            "options": of_this_machine(method, parsed_options(option or [])),
            "friction": friction,
            "min_distance": min_distance,
            "fidelity": chosen_fidelity(fidelity, contact_solver),
        }
    )
    mesh = object_options(
        units=units, scale_to=scale_to, keep_largest=keep_largest, compound=compound, allow_open=allow_open
    )
    place = parse_scene(scene, faces=faces, touch=touch, beside=with_ or [])
    settings = engine_settings()
    with told_to_stop() as stop, _bar(quiet=json) as progress:
        try:
            made = synthesized(
                hand,
                object_,
                request,
                place=place,
                scenes=scenes,
                mesh=mesh,
                device=device,
                threads=threads,
                prefilter=settings.prefilter,
                join=join,
                processes=settings.processes,
                progress=progress,
                cancelled=lambda: bool(stop),
                partial=True,
            )
        except TaskCancelled:
            fail(f"interrupted before any grasp was validated: {out} is not written", 128 + stop[0])
        shard = write_shard("base", made.arrays, {**made.attributes, "shard_id": id_of_columns(made.arrays)})
        write_output(out, shard)
    found = {"file": str(out), **made.summary()}
    if json:
        emit(found)
    else:
        typer.echo(_said(found | ({"reason": None} if made.interrupted else {})))
    if made.interrupted:
        fail(f"interrupted: {out} holds the {found['grasps']} of {grasps} grasps that were there", 128 + stop[0])
    if made.reason is not None:
        raise typer.Exit(FEWER)


def _request(
    want: str, budget: float, validation: str, robust: float, models: int, matter: dict[str, Any]
) -> JobOptions:
    """Options of a job with these; InputError for a word that is none."""
    if want not in ("valid", "candidates"):
        raise InputError(f"unknown --want {want!r}; choose valid or candidates")
    if validation not in (levels := (*get_args(Level), "none")):
        raise InputError(f"unknown validator {validation!r}; choose one of {one_of(validation, levels)}")
    # A recheck is a sample that watches over many jobs; a file can be validated under the DexGraspBench protocol whole.
    try:
        return JobOptions(
            want=want, budget=budget, validation=validation, rechecks=0, robust=robust, robust_models=models, **matter
        )
    except ValidationError as error:
        raise InputError(refusal(error, JobOptions)) from None


@contextmanager
def _bar(*, quiet: bool) -> Iterator[Report]:
    """A progress bar on a terminal; gives what is told of the grasps that are done."""
    if quiet or not sys.stderr.isatty():
        yield lambda done, total, message: None
        return
    # Where nobody looks at a bar, what draws it need not be loaded.
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    began = time.perf_counter()
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=plain_console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=None, rate="")

        def tell(done: float, total: float, message: str) -> None:
            rate = f"{done / max(time.perf_counter() - began, 1e-3):.1f} grasps/s"
            bar.update(task, completed=done, total=total, description=message, rate=rate)

        yield tell


def _said_of_models(found: dict[str, Any]) -> str:
    """How far the verdicts can be trusted, in a line."""
    share, not_robust = found["robust_share"], found["not_robust"]
    if share is None:
        return (
            f"none is robust; {not_robust} hold in the nominal model, and in too few of {found['robust_models']} others"
        )
    models = f"of {found['robust_models']} models around the nominal one"
    if not (wanted := found["robust_wanted"]) or found["want"] != "valid":
        return f"they hold in {share:.0%} {models}"
    return f"each holds in {wanted:.0%} {models} or more; {not_robust} valid ones did not"


def _said(found: dict[str, Any]) -> str:
    """The summary as a line; the second one tells what is missing."""
    validated, mean = found["validation"] != "none", found["mean"]
    word = "valid" if validated else "feasible"
    lines = [
        f"{found['file']}: {found[word]} {word} of {found['candidates']} candidates"
        f"{', validated at level ' + found['validation'] if validated else '; not validated (--validation none)'}"
        f"{' with ' + format(found['mass_kg'], '.3g') + ' kg' if validated else ''}, "
        f"{found['grasps_per_second']:.1f} grasps/s"
    ]
    if "robust_share" in found:
        lines.append(_said_of_models(found))
    if found["grasps"]:
        lines[0] += (
            f"; mean epsilon {mean['epsilon']:.3f}, contact {mean['contact_area_cm2']:.1f} cm^2, "
            f"penetration {mean['penetration_depth_mm']:.2f} mm"
        )
        types = ", ".join(f"{number} {name}" for name, number in found["types"].items())
        lines.append(f"{types}; from {found['directions_used']} of {DIRECTION_CELLS} directions")
    if found.get("payload_kg") is not None:
        lines.append(f"median payload {found['payload_kg']:.2f} kg")
    if found.get("shake_share") is not None:
        lines.append(f"{found['shake_share']:.0%} survive the shake")
    if "scene" in found:
        lines.append(
            f"{found['scene']}, {found['scenes']} scenes: {found['clear_share']:.0%} of the candidates are clear, "
            f"{found['lift_share']:.0%} lift, {found['lift_hard_share']:.0%} at half the friction"
        )
        lines += [note for note in [rolling_note(found["rolling_scenes"], found["scenes"])] if note]
    if (why := found["reason"] or found.get("narrow")) is not None:
        lines.append(why)
    return "\n".join(lines)
