"""Command line: `graspd stability`."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from json import loads
from pathlib import Path
from typing import Annotated, Final

import typer

from service.cli import JsonFlag, emit, load_settings, reporting_errors
from service.model.clock import timestamp
from service.model.errors import InputError, one_of
from service.model.studies import Stability, from_json
from service.model.version import PACKAGE_VERSION

app = typer.Typer()

STUDIES: Final = (
    "time_step",
    "stiffness",
    "contact_count",
    "gradient",
    "shapes",
    "starts",
    "rates",
    "length",
    "hands",
    "model_errors",
    "peers",
    "scene_height",
    "scene_wall",
    "scene_neighbours",
    "scene_size",
)


@app.command(epilog="graspd stability --only gradient --only starts --out stability --publish")
@reporting_errors
def stability(
    only: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(STUDIES)}; several times.")] = None,
    hand: Annotated[str, typer.Option(help="A URDF or a built-in hand.")] = "allegro",
    object_: Annotated[str, typer.Option("--object", help="A mesh or a built-in object.")] = "block",
    quick: Annotated[bool, typer.Option("--quick", help="Few cells of each map: under a minute of CPU time.")] = False,
    long: Annotated[bool, typer.Option("--long", help="Runs of 100,000 iterations as well.")] = False,
    threads: Annotated[int, typer.Option(help="CPU threads; 0: all cores.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for stability.json, stability.md and the maps.")] = None,
    source: Annotated[
        list[Path] | None,
        typer.Option("--from", help="A stability.json: draw and publish its maps, measure nothing; several times."),
    ] = None,
    publish: Annotated[bool, typer.Option("--publish", help="Also into the store, for the dashboard.")] = False,
    data_dir: Annotated[Path | None, typer.Option(help="Folder of the store; GRASPD_DATA_DIR.")] = None,
    json: JsonFlag = False,
) -> None:
    """Drive integrators and the planner to where they fail, and draw the maps."""
    from worker.studies.stability.report import markdown, write

    if unknown := [name for name in only or [] if name not in STUDIES]:
        raise InputError(f"there is no study {unknown[0]!r}; choose of {one_of(unknown[0], STUDIES)}")
    if source:
        found = _joined([_read(path) for path in source])
        found = replace(found, maps=[one for one in found.maps if not only or one.name in only])
    else:
        found = _measured(tuple(only or STUDIES), hand, object_, quick=quick, long=long, threads=threads)
    if out is not None:
        write(found, out)
    key = _publish(found, data_dir) if publish else None
    if json:
        good = {one.name: {panel: one.share(panel) for panel in one.panels} for one in found.maps}
        still = {one.name: one.still_breaks() for one in found.maps}
        emit({"good": good, "still_breaks": still, "out": None if out is None else str(out), "published": key})
    else:
        typer.echo(markdown(found))


def _measured(names: tuple[str, ...], hand: str, obj: str, *, quick: bool, long: bool, threads: int) -> Stability:
    from worker.engines import backend

    backend.start()
    import warp as wp

    from worker.run import Run
    from worker.studies.stability.studies import run

    maps = run(names, hand, obj, quick=quick, long=long, work=Run(threads=threads), say=_say)
    command = shlex.join(["graspd", *(Path(word).name if "/" in word else word for word in sys.argv[1:])])
    return Stability(timestamp(), command, {"graspd": PACKAGE_VERSION, "warp": wp.__version__}, maps)


def _read(path: Path) -> Stability:
    try:
        return from_json(loads(path.read_text()))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError):
        raise InputError(f"{path} is no stability.json; `graspd stability --out FOLDER` writes one") from None


def _joined(parts: list[Stability]) -> Stability:
    """Several runs as one: the later one's map where both have it."""
    maps = {one.name: one for part in parts for one in part.maps}
    commands = "; ".join(dict.fromkeys(part.command for part in parts))
    return replace(parts[-1], command=commands, maps=list(maps.values()))


def _publish(found: Stability, data_dir: Path | None) -> str:
    from service.store.records import STABILITY, publish
    from service.store.store import open_store

    store = open_store(load_settings(data_dir=data_dir).resolved_store_url)
    key = publish(store, STABILITY, found.as_json())
    _say(f"published as {key}")
    return key


def _say(line: str) -> None:
    typer.echo(line, err=True)
