"""`graspd projects`: list projects, and limit what each may use."""

from __future__ import annotations

from typing import Annotated

import typer

from api.access.keys import KeyFile, ProjectLimits
from service.cli import JsonFlag, emit, load_settings, plain_console, plain_table, reporting_errors
from service.model.errors import InputError

app = typer.Typer(no_args_is_help=True, help="List projects of keys, and limit what each may use.")


@app.command("list", epilog="graspd projects list --json")
@reporting_errors
def list_projects(json: JsonFlag = False) -> None:
    """Projects that keys belong to, and their limits. `graspd keys add NAME --project PROJECT` makes one."""
    file = KeyFile(load_settings().resolved_keys_file)
    live: dict[str, list[str]] = {}
    for key in file.list():
        if key.is_live and key.name not in live.setdefault(key.project, []):
            live[key.project].append(key.name)
    found = file.projects()
    if json:
        rows = [
            {"project": name, "keys": live.get(name, []), "limits": limits.model_dump(exclude_none=True)}
            for name, limits in found.items()
        ]
        emit({"projects": rows})
        return
    table = plain_table("project", "keys", "limits")
    for name, limits in found.items():
        table.add_row(name, ", ".join(live.get(name, [])) or "none that opens", _shown(limits))
    plain_console().print(table if found else "no project yet; `graspd keys add NAME --project PROJECT` makes one")


@app.command("limit", epilog="graspd projects limit vision --grasps-per-day 1000000 --gpu-seconds-per-day 86400")
@reporting_errors
def limit_project(
    name: Annotated[str, typer.Argument(help="The project.")],
    grasps_in_flight: Annotated[int | None, typer.Option(min=0, help="Grasps in unfinished jobs; 0: no limit.")] = None,
    grasps_per_day: Annotated[int | None, typer.Option(min=0, help="Grasps asked for a day; 0: no limit.")] = None,
    gpu_seconds_per_day: Annotated[
        int | None, typer.Option(min=0, help="Seconds of GPU workers a day (UTC), then no new job; 0: no limit.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Change what the keys of a project may use together; it counts from the next submission on."""
    given = {
        "grasps_in_flight": grasps_in_flight,
        "grasps_per_day": grasps_per_day,
        "gpu_seconds_per_day": gpu_seconds_per_day,
    }
    wanted = ProjectLimits(**{limit: value for limit, value in given.items() if value is not None})
    if not wanted.model_fields_set:
        raise InputError("give at least one limit, such as --grasps-per-day 1000000")
    limits = KeyFile(load_settings().resolved_keys_file).limit_project(name, wanted)
    if json:
        emit({"project": name, "limits": limits.model_dump(exclude_none=True)})
        return
    typer.echo(f"limits of {name}: {_shown(limits)}")


def _shown(limits: ProjectLimits) -> str:
    found = {name: value for name, value in limits.model_dump().items() if value}
    return ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in found.items()) or "none"
