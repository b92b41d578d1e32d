"""Command line: `graspd objects check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from graspd.service.cli import CommandGroup, JsonFlag, print_json
from graspd.service.command_options import with_options
from graspd.service.model.errors import GraspdError, InputError
from graspd.service.model.object_options import ObjectOptions
from graspd.service.model.states import AssetKind
from graspd.service.store.asset_summary import print_check, verdict_line
from graspd.service.store.assets import builtin_names
from graspd.service.store.object_sets import Objects, find_set_objects
from graspd.worker.objects.check import check_object
from graspd.worker.objects.prepare import files_from_path, object_from_path

app = CommandGroup(add_completion=False)


@app.command("check", epilog="graspd objects check banana.stl --units mm --picture banana.png")
@with_options(ObjectOptions, "asset")
def check(
    file: Annotated[str, typer.Argument(help="Mesh, URDF, SDF, MJCF, folder, ZIP, or built-in object.")],
    options: dict[str, Any],
    picture: Annotated[Path | None, typer.Option(help="PNG of the prepared mesh.")] = None,
    json: JsonFlag = False,
) -> None:
    """Check whether a mesh can be used; report its repairs and its size. Needs no server."""
    if several := _object_set(file):
        if picture:
            raise InputError(f"--picture draws one object; {file} holds {len(several)}")
        _check_set(several, options, json=json)
        return
    report = report_object(file, options)
    if picture and report["verdict"] != "refuse":
        from graspd.worker.rendering.portraits import object_portrait, write_png

        write_png(object_portrait(object_from_path(file, options=options)), picture)
    if json:
        print_json(report)
    else:
        print_check(AssetKind.OBJECT, report)
    if report["verdict"] == "refuse":
        raise typer.Exit(InputError.exit_code)


def _object_set(file: str) -> Objects | None:
    """Return the objects of a folder, or of a ZIP of several; None for one object."""
    if file in builtin_names(AssetKind.OBJECT) and not Path(file).is_file():
        return None
    try:
        return find_set_objects(Path(file))
    except InputError:
        if Path(file).is_dir():
            raise
        return None


def _check_set(objects: Objects, options: dict[str, Any], *, json: bool) -> None:
    reports = []
    for name, files in objects.items():
        reports.append({"name": name, **check_object(files, name, **options)})
        if not json:
            typer.echo(verdict_line(reports[-1]))
    refused = [str(one["name"]) for one in reports if one["verdict"] == "refuse"]
    if json:
        print_json({"objects": reports, "refused": refused})
    if refused:
        raise InputError(f"{len(refused)} of {len(reports)} objects were refused: {', '.join(refused[:5])}")


def report_object(file: str, options: dict[str, Any] | None = None) -> dict[str, Any]:
    """Run `check_object` on a path; report an unreadable file in the same form."""
    try:
        name, files, stated = files_from_path(file)
    except GraspdError as error:
        return {"verdict": "refuse", "message": str(error), "repairs": [], "facts": {}}
    given = {key: value for key, value in (options or {}).items() if value is not None}
    return check_object(files, name, **{**stated, **given})
