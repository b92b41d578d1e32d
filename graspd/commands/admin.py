"""Command line: `graspd admin kernels` and `gallery`."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graspd.service.cli import CommandGroup, JsonFlag, report
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
