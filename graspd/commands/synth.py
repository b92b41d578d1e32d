"""`graspd synth`: make grasps as a job does, without queue or server."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from graspd.service import cli
from graspd.service.command_options import parse_pairs, validate_options, with_options
from graspd.service.model.errors import InputError, TaskCancelled
from graspd.service.model.local_options import LocalOptions
from graspd.service.model.metrics import DIRECTION_CELLS
from graspd.service.store.shards import write_shard

app = cli.CommandGroup()
FEWER: Final = 3


@app.command(epilog="graspd synth --hand allegro --object mug -n 32 -o grasps.h5")
@with_options(LocalOptions, "synth")
def synth(
    hand: Annotated[str, typer.Option(help="URDF, ZIP with a URDF, or name of a built-in hand.")],
    object_: Annotated[str, typer.Option("--object", help="Mesh (STL, OBJ, PLY, GLB, OFF) or built-in object.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="HDF5 file to write.")],
    options: dict[str, Any],
    json: cli.JsonFlag = False,
) -> None:
    """Generate, validate and measure grasps of one hand on one object as a job does; write an HDF5 file.

    Exit code 3: fewer grasps than requested. Ctrl-C saves the validated grasps.
    """
    from graspd.worker.files.provenance import id_of_columns  # Help and completion need no engine.
    from graspd.worker.files.synthesis import synthesize_with_options

    if not out.parent.is_dir():
        raise InputError(f"the folder {out.parent} does not exist; create it or choose another --out")
    if out.is_dir():
        raise InputError(f"{out} is a folder; name a file in it, such as --out {out / 'grasps.h5'}")
    options["options"] = parse_pairs(options.get("options", ()))
    asked = validate_options(LocalOptions, options)
    if "payload" not in options and asked.scene_spec.kind != "free" and asked.validation != "none":
        asked = asked.model_copy(update={"payload": asked.mass is not None or asked.density is not None})
    settings, began = cli.load_settings(), time.perf_counter()
    with cli.catch_stop_signals() as stop, cli.progress_bar(quiet=json) as report:

        def progress(done: float, total: float, message: str) -> None:
            rate = done / max(time.perf_counter() - began, 1e-3)
            report(done, total, f"{message}, {rate:.1f} grasps/s")

        try:
            made = synthesize_with_options(
                hand,
                object_,
                asked,
                prefilter=settings.prefilter,
                processes=settings.processes,
                progress=progress,
                cancelled=lambda: bool(stop),
                partial=True,
            )
        except TaskCancelled:
            cli.fail(f"interrupted before any grasp was validated: {out} is not written", 128 + stop[0])
        shard = write_shard("base", made.arrays, {**made.attributes, "shard_id": id_of_columns(made.arrays)})
        cli.write_output(out, shard)
    found = {"file": str(out), **made.summary()}
    cli.print_result(found, _format_summary(found | ({"reason": None} if made.interrupted else {})), json=json)
    if made.interrupted:
        cli.fail(f"interrupted: {out} contains {found['grasps']} of {asked.grasps} grasps", 128 + stop[0])
    if made.reason is not None:
        raise typer.Exit(FEWER)


def _format_robustness(found: dict[str, Any]) -> str:
    share, not_robust = found["robust_share"], found["not_robust"]
    models = f"of {found['robust_models']} perturbed models"
    if share is None:
        return f"no grasp is robust; {not_robust} hold in the nominal model, but in too few {models}"
    if not (wanted := found["robust_wanted"]) or found["want"] != "valid":
        return f"the valid grasps hold in {share:.0%} {models}"
    return f"each grasp holds in at least {wanted:.0%} {models}; {not_robust} held grasps are not robust"


def _format_summary(found: dict[str, Any]) -> str:
    validated, mean = found["validation"] != "none", found["mean"]
    word = "valid" if validated else "feasible"
    lines = [
        f"{found['file']}: {found[word]} {word} of {found['candidates']} candidates"
        f"{', validated at level ' + found['validation'] if validated else '; not validated (--validation none)'}"
        f"{' with ' + format(found['mass_kg'], '.3g') + ' kg' if validated else ''}, "
        f"{found['grasps_per_second']:.1f} grasps/s"
    ]
    if "robust_share" in found:
        lines.append(_format_robustness(found))
    if found["grasps"]:
        lines[0] += (
            f"; mean epsilon {mean['epsilon']:.3f}, contact {mean['contact_area_cm2']:.1f} cm^2, "
            f"penetration {mean['penetration_depth_mm']:.2f} mm"
        )
        types = ", ".join(f"{number} {name}" for name, number in found["types"].items())
        lines.append(f"{types}; from {found['directions_used']} of {DIRECTION_CELLS} directions")
    if found.get("payload_kg") is not None:
        lines.append(f"median payload {found['payload_kg']:.2f} kg")
    if second := found.get("second_engines"):
        held = f"{second['second_held']} of {second['second_tested']} valid grasps"
        lines.append(f"{held} hold in {' and '.join(second['names'])}")
    if found.get("shake_share") is not None:
        lines.append(f"{found['shake_share']:.0%} survive the shake")
    if "scene" in found:
        lines.append(
            f"{found['scene']}, {found['scenes']} scenes: {found['clear_share']:.0%} of the candidates are clear, "
            f"{found['lift_share']:.0%} lift, {found['lift_hard_share']:.0%} at half the friction"
        )
        from graspd.worker.scenes.rest import rolling_note

        lines += [note for note in [rolling_note(found["rolling_scenes"], found["scenes"])] if note]
    if (why := found["reason"] or found.get("narrow")) is not None:
        lines.append(why)
    return "\n".join(lines)
