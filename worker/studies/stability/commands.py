"""Command line: `graspd stability`."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Final

import typer

from service.cli import JsonFlag, emit, reporting_errors
from service.errors import InputError
from service.version import PACKAGE_VERSION

app = typer.Typer()

STUDIES: Final = ("time_step", "stiffness", "contact_count", "gradient", "shapes", "starts", "rates", "length")


@app.command(epilog="graspd stability --only gradient --only starts --out stability")
@reporting_errors
def stability(
    only: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(STUDIES)}; several times.")] = None,
    hand: Annotated[str, typer.Option(help="A URDF or a built-in hand.")] = "allegro",
    object_: Annotated[str, typer.Option("--object", help="A mesh or a built-in object.")] = "block",
    quick: Annotated[
        bool, typer.Option("--quick", help="Few cells of each map: a minute, not a quarter of an hour.")
    ] = False,
    long: Annotated[bool, typer.Option("--long", help="Runs of 100,000 iterations as well.")] = False,
    threads: Annotated[int, typer.Option(help="CPU threads; 0: all cores.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for stability.json, stability.md and the maps.")] = None,
    json: JsonFlag = False,
) -> None:
    """Drive integrators and the planner to where they fail, and draw the maps."""
    if unknown := [name for name in only or [] if name not in STUDIES]:
        raise InputError(f"there is no study {unknown[0]!r}; choose of {', '.join(STUDIES)}")
    from worker import backend

    backend.start()
    import warp as wp

    from worker.studies.stability.report import markdown, write
    from worker.studies.stability.studies import run

    maps = run(
        tuple(only or STUDIES), hand, object_, quick=quick, long=long, threads=threads,
        say=lambda line: typer.echo(line, err=True),
    )  # fmt: skip
    command = shlex.join(["graspd", *(Path(word).name if "/" in word else word for word in sys.argv[1:])])
    versions = {"graspd": PACKAGE_VERSION, "warp": wp.__version__}
    if out is not None:
        write(maps, out, command=command, versions=versions)
    if json:
        counts = {one.name: {panel: one.share(panel) for panel in one.panels} for one in maps}
        emit({"good": counts, "out": None if out is None else str(out)})
    else:
        typer.echo(markdown(maps, command=command, versions=versions))
