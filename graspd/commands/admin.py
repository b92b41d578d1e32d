"""Command line: `graspd admin kernels`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from graspd.service.cli import CommandGroup, JsonFlag, report

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
