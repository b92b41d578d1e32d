"""Command line: `graspd scene`."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer

from service.cli import JsonFlag, emit, reporting_errors
from service.shards import Shard, read_shard, write_shard
from worker.grasps import Posture
from worker.scenes.clearance import transfer
from worker.scenes.simulate import drop
from worker.scenes.sources import hand_of_shard, object_of_shard

app = typer.Typer(add_completion=False)


@app.command(epilog="graspd scene grasps.h5 --scenes 4 -o scenes.h5")
@reporting_errors
def scene(
    grasps: Annotated[Path, typer.Argument(help="A base shard, as `graspd synth` writes it.")],
    scenes: Annotated[int, typer.Option(min=1, max=4096, help="Number of scenes.")] = 2,
    hand: Annotated[str | None, typer.Option(help="The hand's file; default: the built-in of that name.")] = None,
    object: Annotated[str | None, typer.Option(help="The object's file; default: the built-in of that name.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Default: the seed of the grasps.")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="The scene shard to write.")] = Path("scenes.h5"),
    json: JsonFlag = False,
) -> None:
    """Drop the object onto a table and keep the grasps that the hand can reach there."""
    started = perf_counter()
    base = read_shard(grasps, kind="base")
    model, obj = hand_of_shard(base, hand), object_of_shard(base, object)
    number = int(base.attributes.get("seed", 0)) if seed is None else seed  # type: ignore[arg-type]
    result: dict[str, Any] = dict(drop(obj, count=scenes, seed=number))
    result |= transfer(model, _posture(base, "grasp"), _posture(base, "pregrasp"), result["scene/object_pose"])
    seconds = perf_counter() - started
    kept = {key: base.attributes[key] for key in INHERITED if key in base.attributes}
    data = write_shard("scene", result, {**kept, "seed": number, "device": "cpu", "seconds": round(seconds, 4)})
    output.write_bytes(data)
    valid, total = int(result["grasp/valid"].sum()), len(result["grasp/valid"])
    summary = {"file": str(output), "scenes": scenes, "grasps": total, "valid": valid, "seconds": round(seconds, 2)}
    if json:
        emit(summary)
    else:
        typer.echo(f"{output}: {scenes} scenes, {valid} of {total} grasps clear of the table, {seconds:.1f} s")


#: What every later shard says about the job it comes from.
INHERITED = ("hand", "hand_digest", "object", "object_digest", "method", "fidelity", "batch", "root_link")


def _posture(base: Shard, name: str) -> Posture:
    return Posture(base.arrays[f"{name}/hand_pose"], base.arrays[f"{name}/joint_positions"])  # type: ignore[arg-type]
