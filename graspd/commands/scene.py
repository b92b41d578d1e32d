"""Command line: `graspd scene` and `graspd transfer`."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer

from graspd.service.cli import CommandGroup, JsonFlag, print_result, write_output
from graspd.service.store.columns import Attribute
from graspd.service.store.shards import read_shard, write_shard
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files import provenance
from graspd.worker.files.transfer import transfer_grasps as transfer_to_hand
from graspd.worker.grasps import Posture
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.scenes.clearance import count_rejections, transfer_grasps
from graspd.worker.scenes.neighbours import Neighbours, drop_together
from graspd.worker.scenes.rest import count_rolling_poses, rolling_note
from graspd.worker.scenes.simulate import drop

app = CommandGroup(add_completion=False)


@app.command(epilog="graspd scene grasps.h5 --scenes 4 -o scenes.h5")
def scene(
    grasps: Annotated[Path, typer.Argument(help="Base shard, as written by `graspd synth`.")],
    scenes: Annotated[int, typer.Option(min=1, max=4096, help="Number of scenes.")] = 2,
    hand: Annotated[str | None, typer.Option(help="Hand file; default: found by its digest.")] = None,
    object: Annotated[str | None, typer.Option(help="Object file; default: found by its digest.")] = None,
    with_: Annotated[list[str] | None, typer.Option("--with", help="Neighbour: file or built-in; repeatable.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the scenes; default: that of the grasps.")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Scene shard to write.")] = Path("scenes.h5"),
    json: JsonFlag = False,
) -> None:
    """Drop the object on a table and select the grasps that are clear there."""
    started = perf_counter()
    base = read_shard(grasps, kind="base")
    model, obj = provenance.hand_of_shard(base, hand), provenance.object_of_shard(base, object)
    number = int(base.attributes.get("seed", 0)) if seed is None else seed  # type: ignore[arg-type]
    others = [object_from_path(name, face_error_m=provenance.NEIGHBOUR_FACE_ERROR_M) for name in with_ or []]
    dropped = drop_together(obj, others, count=scenes, seed=number) if others else drop(obj, count=scenes, seed=number)
    result: dict[str, Any] = dict(dropped)
    poses = result["scene/object_pose"]
    neighbours = Neighbours(others, result["scene/neighbour_pose"]) if others else None
    grasp, pregrasp = (Posture.from_columns(base.arrays, name) for name in ("grasp", "pregrasp"))
    result |= transfer_grasps(model, grasp, pregrasp, poses, neighbours)
    seconds = perf_counter() - started
    attributes: dict[str, Attribute] = {
        key: base.attributes[key] for key in provenance.INHERITED if key in base.attributes
    }
    attributes |= {"seed": number, "device": "cpu", "seconds": round(seconds, 4)}
    attributes |= provenance.wrist_attributes(model) | provenance.neighbour_attributes(others, with_ or [])
    attributes |= provenance.source_attributes(base) | {"shard_id": provenance.id_of_columns(result)}
    write_output(output, write_shard("scene", result, attributes))
    clear, total = int(result["grasp/valid"].sum()), len(result["grasp/valid"])
    rolling = count_rolling_poses(obj, poses)
    reasons = count_rejections(result["grasp/rejection"])
    found = {"file": str(output), "scenes": scenes, "grasps": total, "clear": clear, "rejected": reasons}
    found |= {"rolling_scenes": rolling, "seconds": round(seconds, 2)}
    lines = [f"{output}: {scenes} scenes, {clear} of {total} grasps are clear, {seconds:.1f} s"]
    if any(reasons.values()):
        lines.append("too near: " + ", ".join(f"{n} {reason.replace('_', ' ')}" for reason, n in reasons.items() if n))
    if (note := rolling_note(rolling, scenes)) is not None:
        lines.append(note)
    print_result(found, "\n".join(lines), json=json)


@app.command(epilog="graspd transfer grasps.h5 --hand shadow -o transferred.h5")
def transfer(
    file: Annotated[Path, typer.Argument(help="Base shard with grasps of a free object.")],
    hand: Annotated[str, typer.Option(help="Hand to transfer to: file or built-in name.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="HDF5 file to write.")],
    source_hand: Annotated[str | None, typer.Option(help="Hand file of the grasps; default: by its digest.")] = None,
    object: Annotated[str | None, typer.Option(help="Object file; default: found by its digest.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first grasp.")] = 0,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0: one per core.")] = 0,
    json: JsonFlag = False,
) -> None:
    """Plan a grasp of another hand for each valid grasp: same type, contact region and approach."""
    shard = read_shard(file, kind="base")
    run = ExecutionContext(threads=threads)
    arrays, attributes = transfer_to_hand(shard, hand, source_hand=source_hand, obj=object, seed=seed, run=run)
    write_output(out, write_shard("base", arrays, attributes))
    count, valid = len(arrays["quality/valid"]), int((shard["quality/valid"] == 1).sum())
    line = f"{out}: {count} of {valid} valid grasps of {file} transferred to {attributes['hand']}"
    print_result({"file": str(out), "grasps": count, "source_grasps": valid}, line, json=json)
