"""Command line: `graspd grasps where`, `graspd datasets balance` and `graspd clouds`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from graspd.service.cli import CommandGroup, JsonFlag, print_result
from graspd.service.model.errors import InputError
from graspd.service.readers import Pictures
from graspd.service.readers.clouds import Frame
from graspd.service.readers.depth_noise import NOISES
from graspd.service.readers.where import compile_expression
from graspd.worker.files.clouds import hand_surface, write_clouds
from graspd.worker.files.curation import KINDS, Balance
from graspd.worker.files.subsets import UnvalidatedOption, open_source, write_subset

app = CommandGroup(no_args_is_help=True, add_completion=False)
group = CommandGroup(no_args_is_help=True, help="Select grasps of files and datasets by their metrics.")
app.add_typer(group, name="grasps")

SourceArgument = Annotated[str, typer.Argument(help="File, folder of shards, or name of a dataset in the store.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder to write; it must not exist.")]


@group.callback()
def grasps() -> None:
    """Select grasps of files and datasets by their metrics."""


@group.command(epilog='graspd grasps where "epsilon > 0.3 and lift and robust >= 0.75" --from kitchen -o subset')
def where(
    expression: Annotated[str, typer.Argument(help="Metrics and verdicts (valid, held, lift); and, or, not.")],
    out: OutOption,
    source: Annotated[str, typer.Option("--from", help="File, folder of shards, or name of a dataset.")] = ".",
    json: JsonFlag = False,
) -> None:
    """Write the grasps that satisfy an expression as new base shards."""
    test = compile_expression(expression)
    said = {"where": expression, "from": source}
    found = write_subset(
        open_source(source), lambda some: [test(shard.arrays, shard.attributes) for shard in some], out, said=said
    )
    _report(found, out, json=json)


@app.command(epilog="graspd datasets balance kitchen --by type,direction -o even")
def balance(
    source: SourceArgument,
    out: OutOption,
    by: Annotated[
        str | None, typer.Option(help=f"Kinds, comma-separated: {', '.join(KINDS)}; default: type,direction.")
    ] = None,
    at_most: Annotated[int, typer.Option(min=0, help="Maximum per kind and cell; 0: the median over kinds.")] = 0,
    min_distance: Annotated[
        float, typer.Option(min=0, max=0.1, help="Minimum distance between grasps of a cell [m]; 0: any.")
    ] = 0.0,
    spread: Annotated[
        int, typer.Option(min=0, help="Number of most different grasps per hand and object, and per kind of --by.")
    ] = 0,
    hand: Annotated[str | None, typer.Option(help="Hand file for distances; default: found by its digest.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random selection within a kind.")] = 0,
    json: JsonFlag = False,
) -> None:
    """Write a subset of a dataset with no kind of valid grasps more frequent, or the most different ones."""
    by = ("" if spread else "type,direction") if by is None else by
    kinds = [one.strip() for one in by.split(",") if one.strip()]
    chooser = Balance(kinds, at_most, min_distance, seed, hand, spread)
    said = {"balance": kinds, "from": source, "at_most": at_most, "min_distance": min_distance, "seed": seed}
    said |= {"spread": spread} if spread else {}
    _report(write_subset(open_source(source), chooser, out, said=said), out, json=json)


def _report(found: dict[str, int], out: Path, *, json: bool) -> None:
    line = f"{out}: {found['kept']} of {found['looked_at']} grasps in {found['shards']} shards"
    print_result({"folder": str(out), **found}, line, json=json)
    if found["passed_over"] and not json:
        typer.echo(f"{found['passed_over']} shards of scenes and pictures are not copied", err=True)


@app.command(epilog="graspd clouds kitchen --points 1024 --noise stereo -o clouds")
def clouds(
    source: Annotated[str, typer.Argument(help="Folder of shards with pictures, or name of a dataset in the store.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write; it must be new or empty.")],
    points: Annotated[int, typer.Option(min=1, max=10_000_000, help="Points per cloud.")] = 1024,
    noise: Annotated[str, typer.Option(help=f"Noise model of a depth camera: {', '.join(NOISES)}; or none.")] = "none",
    frame: Annotated[Frame | None, typer.Option(help="Frame of points; default: camera, with --fuse table.")] = None,
    fuse: Annotated[bool, typer.Option("--fuse", help="Fuse all views of a scene into one cloud.")] = False,
    scene: Annotated[bool, typer.Option("--scene", help="Include table and neighbours.")] = False,
    voxel: Annotated[float, typer.Option(min=0, help="Size of voxels with one point each [m]; 0: all points.")] = 0.0,
    graspness: Annotated[bool, typer.Option("--graspness", help="Add the share of grasps that touch a point.")] = False,
    unvalidated: UnvalidatedOption = False,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same clouds.")] = 0,
    json: JsonFlag = False,
) -> None:
    """Write the pictures of a dataset as point clouds with their grasps: docs/how-to/clouds.md.

    In Python, `Pictures(shards).clouds()` computes the same clouds without files.
    """
    pictures = Pictures(open_source(source), unvalidated=unvalidated)
    if not len(pictures):
        raise InputError(f"{source} has no pictures; make some: graspd render")
    camera = None if noise == "none" else noise
    surface = hand_surface if graspness else None
    found = pictures.clouds(
        points, noise=camera, frame=frame, fuse=fuse, scene=scene, voxel_m=voxel, hand_surface=surface, seed=seed
    )
    said = {"source": source, "points": points, "noise": noise, "frame": found.frame, "fuse": fuse, "scene": scene}
    more = {"voxel_m": voxel, "graspness": graspness, "unvalidated": unvalidated, "seed": seed}
    done = write_clouds(found, out, said | more)
    line = f"{out}: {done['clouds']} clouds in {done['files']} files, {done['empty']} of them empty"
    print_result({"folder": str(out), **done}, line, json=json)
