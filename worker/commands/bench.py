"""Command line: `graspd bench`."""

from __future__ import annotations

import json as json_
from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli import JsonFlag, emit, reporting_errors
from service.model.cores import available_cores
from service.model.errors import InputError, one_of
from service.model.fidelity import FIDELITIES, OFFERED, Fidelity
from worker.engines.devices import Device

app = typer.Typer()


@app.command(epilog="graspd bench --hand allegro --object mug --batch 1 --batch 32 --out bench")
@reporting_errors
def bench(
    hand: Annotated[str, typer.Option(help="A URDF, a ZIP with one, or a built-in hand.")] = "allegro",
    object_: Annotated[str, typer.Option("--object", help="A mesh or a built-in object.")] = "mug",
    fidelity: Annotated[list[str] | None, typer.Option(help="Fidelity; several times. Default: all offered.")] = None,
    batch: Annotated[list[int] | None, typer.Option(min=1, help="Grasps per call; several times.")] = None,
    join: Annotated[list[int] | None, typer.Option(min=1, help="Batches in one launch; several times.")] = None,
    threads: Annotated[list[int] | None, typer.Option(min=1, help="CPU threads; several times.")] = None,
    points: Annotated[list[int] | None, typer.Option(min=16, help="Also sweep the fine phase's hand points.")] = None,
    face_error: Annotated[list[float] | None, typer.Option(min=0, help="Also sweep the face error bound [m].")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda:0 or auto.")] = "auto",
    repeats: Annotated[int, typer.Option(min=1, help="Timed calls per run; the median counts.")] = 3,
    out: Annotated[Path | None, typer.Option(help="Folder for bench.json, bench.md and bench.png.")] = None,
    json: JsonFlag = False,
) -> None:
    """Grasps per second of the planner, without the quality table, and where the time goes."""
    from worker.hands.load import hand_from_path
    from worker.objects.prepare import object_from_path
    from worker.studies.bench import bench as measure
    from worker.studies.bench import table, write

    resolved = Device(device).resolve()
    result = measure(
        hand_from_path(hand),
        lambda error: object_from_path(object_, face_error_m=error),
        fidelities=_fidelities(fidelity, points, face_error),
        batches=batch or [1, 8, 32, 256],
        threads=threads or ([1] if resolved != "cpu" else sorted({1, available_cores()})),
        device=resolved,
        repeats=repeats,
        joins=join or [1],
        say=lambda line: typer.echo(line, err=True),
    )
    if out is not None:
        write(result, out)
    if json:
        emit(result)
    else:
        typer.echo(table(result))


def _fidelities(names: list[str] | None, points: list[int] | None, errors: list[float] | None) -> list[Fidelity]:
    """The named fidelities, then the first of them with one knob changed at a time."""
    chosen = names or list(OFFERED)
    if unknown := [name for name in chosen if name not in FIDELITIES]:
        raise InputError(f"unknown fidelity {unknown[0]!r}; choose one of {one_of(unknown[0], FIDELITIES)}")
    found = [FIDELITIES[name] for name in chosen]
    changes: list[dict[str, Any]] = [{"fine_points": n, "name": f"{chosen[0]}/points={n}"} for n in points or []]
    changes += [{"face_error_m": e, "name": f"{chosen[0]}/error={json_.dumps(e)}"} for e in errors or []]
    return found + [Fidelity(**(found[0].model_dump() | change)) for change in changes]
