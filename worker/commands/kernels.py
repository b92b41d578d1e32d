"""Command line: `graspd admin kernels`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from service.cli import JsonFlag, emit, reporting_errors

app = typer.Typer(add_completion=False)


@app.command(epilog="graspd admin kernels ./kernels --arch 90")
@reporting_errors
def kernels(
    folder: Annotated[Path, typer.Argument(help="Where they go; name it in GRASPD_KERNELS.")],
    arch: Annotated[list[int] | None, typer.Option(help="GPU architecture, such as 90; several times.")] = None,
    cuda: Annotated[bool, typer.Option(help="Binaries for GPUs.")] = True,
    cpu: Annotated[bool, typer.Option(help="Objects for CPUs with the instructions of this one.")] = True,
    json: JsonFlag = False,
) -> None:
    """Compile all kernels ahead of time, so that a fresh machine compiles none. No GPU is needed."""
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["WARP_CACHE_PATH"] = str(folder.resolve())
    from worker.engines import backend, baked

    backend.start()
    architectures = (arch or baked.ARCHITECTURES) if cuda else ()
    files = baked.bake(baked.modules(), architectures=architectures, cpu=cpu)
    size = sum(file.stat().st_size for file in files)
    if json:
        emit(
            {
                "folder": str(folder),
                "files": len(files),
                "bytes": size,
                "architectures": list(architectures),
                "cpu": cpu,
            }
        )
    else:
        typer.echo(
            f"{len(files)} files of kernels, {size / 1e6:.1f} MB, in {folder}; GRASPD_KERNELS={folder.resolve()}"
        )
