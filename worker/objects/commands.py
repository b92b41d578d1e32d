"""Command line: `graspd objects check`."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from service.errors import GraspdError
from worker.objects.check import check_object
from worker.objects.prepare import files_from_path


def check(
    file: Annotated[str, typer.Argument(help="a mesh (STL, OBJ, PLY, OFF, GLB), a ZIP, or the name of a built-in")],
    units: Annotated[str | None, typer.Option(help="unit of the file: m, mm, cm or in")] = None,
    scale_to: Annotated[float | None, typer.Option(help="scale the longest extent to this [m]")] = None,
    keep_largest: Annotated[bool, typer.Option("--keep-largest", help="of several components keep one")] = False,
    allow_open: Annotated[bool, typer.Option("--allow-open", help="take a mesh that is not watertight")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on the last line")] = False,
) -> None:
    """Say whether a mesh can be used, what was repaired, and how large it is.

    Example: graspd objects check banana.stl --units mm
    """
    options = {
        "units": units,
        "scale_to": scale_to,
        "keep_largest": keep_largest or None,
        "allow_open": allow_open or None,
    }
    report = report_object(file, options)
    typer.echo(json.dumps(report) if as_json else f"{report['verdict']}: {report['message']}")
    if report["verdict"] == "refuse":
        raise typer.Exit(2)


def report_object(file: str, options: dict[str, Any] | None = None) -> dict[str, Any]:
    """`check_object` of a path; what cannot even be read is refused in the same form."""
    try:
        name, files, stated = files_from_path(file)
    except GraspdError as error:
        return {"verdict": "refuse", "message": str(error), "repairs": [], "facts": {}}
    given = {key: value for key, value in (options or {}).items() if value is not None}
    return check_object(files, name, **{**stated, **given})
