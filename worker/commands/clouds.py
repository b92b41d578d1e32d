"""Command line: `graspd clouds`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli import JsonFlag, emit, reporting_errors
from service.model.errors import InputError
from service.readers import Pictures
from service.readers.clouds import Frame
from service.readers.depth_noise import NOISES
from worker.files.cloud_files import write_clouds
from worker.files.hand_surface import hand_surface
from worker.files.subsets import shards_of

app = typer.Typer(no_args_is_help=True)


@app.command(epilog="graspd clouds kitchen --points 1024 --noise stereo -o clouds")
@reporting_errors
def clouds(
    source: Annotated[str, typer.Argument(help="A folder of shards with pictures, or a dataset of the store.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write; it must be new or empty.")],
    points: Annotated[int, typer.Option(min=1, max=10_000_000, help="Points of each cloud.")] = 1024,
    noise: Annotated[str, typer.Option(help=f"A depth camera: {', '.join(NOISES)}; none.")] = "none",
    frame: Annotated[
        Frame | None, typer.Option(help="camera, table or object; default: the camera's, of fused views the table's.")
    ] = None,
    fuse: Annotated[bool, typer.Option("--fuse", help="One cloud of all views of a scene.")] = False,
    scene: Annotated[bool, typer.Option("--scene", help="Table and neighbours too.")] = False,
    voxel: Annotated[float, typer.Option(min=0.0, help="One point of each cube with this edge [m]; 0: all.")] = 0.0,
    graspness: Annotated[
        bool, typer.Option("--graspness", help="Of each point the share of grasps whose hand touches it.")
    ] = False,
    unjudged: Annotated[bool, typer.Option("--unjudged", help="Grasps that are sound and that nobody judged.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same clouds.")] = 0,
    json: JsonFlag = False,
) -> None:
    """Write the pictures of a dataset as point clouds with their grasps: docs/how-to/clouds.md.

    Who reads with graspd needs no files: `Pictures(shards).clouds()` makes the same when it is asked for.
    """
    pictures = Pictures(shards_of(source), unjudged=unjudged)
    if not len(pictures):
        raise InputError(f"{source} has no pictures; take some: graspd render")
    camera = None if noise == "none" else noise
    surface = hand_surface if graspness else None
    found = pictures.clouds(
        points, noise=camera, frame=frame, fuse=fuse, scene=scene, voxel_m=voxel, hand_surface=surface, seed=seed
    )
    said = {
        "source": source,
        "points": points,
        "noise": noise,
        "frame": found.frame,
        "fuse": fuse,
        "scene": scene,
        "voxel_m": voxel,
        "graspness": graspness,
        "unjudged": unjudged,
        "seed": seed,
    }
    done = write_clouds(found, out, said)
    if json:
        emit({"folder": str(out), **done})
        return
    typer.echo(f"{out}: {done['clouds']} clouds in {done['files']} files, {done['empty']} of them empty")
