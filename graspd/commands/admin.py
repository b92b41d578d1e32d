"""Command line: `graspd admin kernels`, `bench-render` and `gallery`."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graspd.service.cli import CommandGroup, JsonFlag, report
from graspd.service.model.errors import InputError
from graspd.worker.engines.devices import Device

if TYPE_CHECKING:
    from graspd.worker.objects.model import ObjectModel

app = CommandGroup(add_completion=False)


@app.command(epilog="graspd admin kernels ./kernels --arch 90")
def kernels(
    folder: Annotated[Path, typer.Argument(help="Folder for the kernels; set GRASPD_KERNELS to it.")],
    arch: Annotated[list[int] | None, typer.Option(help="GPU architecture, such as 90; repeatable.")] = None,
    cuda: Annotated[bool, typer.Option(help="Compile binaries for GPUs.")] = True,
    cpu: Annotated[bool, typer.Option(help="Compile objects for CPUs with this CPU's instruction set.")] = True,
    json: JsonFlag = False,
) -> None:
    """Compile all kernels ahead of time, so that new machines compile none. No GPU is needed."""
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["WARP_CACHE_PATH"] = str(folder.resolve())
    from graspd.worker.engines import backend

    backend.start()
    architectures = (arch or backend.ARCHITECTURES) if cuda else ()
    files = backend.bake(backend.modules(), architectures=architectures, cpu=cpu)
    size = sum(file.stat().st_size for file in files)
    made = {"folder": str(folder), "files": len(files), "bytes": size, "architectures": list(architectures), "cpu": cpu}
    line = f"{len(files)} kernel files, {size / 1e6:.1f} MB, in {folder}; GRASPD_KERNELS={folder.resolve()}"
    report(made, line, json=json)


@app.command("bench-render", epilog="graspd admin bench-render --object mug --size 320x240 --size 640x480")
def bench_render(
    object: Annotated[str, typer.Option(help="Mesh or built-in object.")] = "mug",
    size: Annotated[list[str] | None, typer.Option(help="Picture size, WIDTHxHEIGHT; repeatable.")] = None,
    device: Annotated[str, typer.Option(help="Warp device: cpu, cuda:0, or auto.")] = "auto",
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs, of which the median is reported.")] = 3,
    json: JsonFlag = False,
) -> None:
    """Measure pictures per second with all channels, per core or GPU, and the time of each step."""
    from graspd.studies.rendering_bench import bench_render as measure
    from graspd.studies.rendering_bench import tables
    from graspd.worker.objects.prepare import object_from_path

    obj, used = object_from_path(object, face_error_m=3e-4), Device(device).resolve()
    results = []
    for width, height in [_size(text) for text in size or ["320x240", "640x480"]]:
        typer.echo(f"{width} x {height} on {used}", err=True)
        results.append(measure(obj, width=width, height=height, device=used, repeats=repeats))
    report({"results": results}, tables(results), json=json)


@app.command(epilog="graspd admin gallery --object mug --object banana.stl -o docs/images/scenes")
def gallery(
    object: Annotated[list[str] | None, typer.Option(help="Built-in object, mesh, or NAME=MESH; repeatable.")] = None,
    hand: Annotated[list[str] | None, typer.Option(help="URDF or built-in hand; repeatable.")] = None,
    device: Annotated[str, typer.Option(help="Warp device: cpu, cuda:0, or auto.")] = "auto",
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same pictures.")] = 0,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")] = Path("gallery"),
    json: JsonFlag = False,
) -> None:
    """Write pages of camera pictures: hands in clear grasps on a table, and cluttered tables."""
    from graspd.studies.gallery import paint
    from graspd.worker.hands.load import hand_from_path

    files = paint(
        [hand_from_path(name) for name in hand or ["allegro", "barrett", "shadow"]],
        [_object(name) for name in object or ["mug", "bottle", "block"]],
        output,
        device=Device(device).resolve(),
        seed=seed,
        say=lambda line: typer.echo(line, err=True),
    )
    names = [str(file) for file in files]
    report({"files": names}, "\n".join(names), json=json)


def _object(text: str) -> ObjectModel:
    from graspd.worker.objects.prepare import object_from_path

    name, _, path = text.rpartition("=")
    obj = object_from_path(path, face_error_m=3e-4)
    return replace(obj, name=name) if name else obj


def _size(text: str) -> tuple[int, int]:
    if not (match := re.fullmatch(r"(\d{2,4})x(\d{2,4})", text)):
        raise InputError(f"{text!r} is no picture size; write WIDTHxHEIGHT, such as 320x240")
    width, height = int(match[1]), int(match[2])
    if not (16 <= width <= 4096 and 16 <= height <= 4096):
        raise InputError(f"width and height of a picture must be 16 to 4096 pixels; got {text}")
    return width, height
