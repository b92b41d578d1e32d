"""`graspd keys`: make, list, rotate, limit and revoke API keys."""

from __future__ import annotations

import re
from datetime import timedelta
from typing import Annotated, Final

import typer

from api.access.keys import Key, KeyFile, KeyLimits, Scope
from api.formatting import minute
from service.cli import JsonFlag, emit, load_settings, plain_console, plain_table, reporting_errors
from service.model.errors import InputError

app = typer.Typer(no_args_is_help=True, help="Make, list, rotate, limit and revoke API keys.")

_UNITS: Final = {"s": "seconds", "m": "minutes", "h": "hours", "d": "days"}

NameArgument = Annotated[str, typer.Argument(help="Whose key it is.")]
ProjectOption = Annotated[
    str, typer.Option(help="Project that it belongs to; keys of other projects see nothing of it.", metavar="NAME")
]
LifetimeOption = Annotated[
    str | None, typer.Option("--expires", help="How long it lives: 90d, 12h; default: for ever.")
]
RequestsOption = Annotated[int | None, typer.Option(min=0, help="Requests a minute; 0: no limit.")]
ConcurrencyOption = Annotated[int | None, typer.Option(min=0, help="Requests answered at once; 0: no limit.")]
GraspsOption = Annotated[int | None, typer.Option(min=0, help="Grasps in unfinished jobs; 0: no limit.")]
JobsOption = Annotated[int | None, typer.Option(min=0, help="New jobs a day (UTC); 0: no limit.")]


@app.command("add", epilog="graspd keys add alice --scope submit --expires 90d --grasps-in-flight 100000")
@reporting_errors
def add_key(
    name: NameArgument,
    scope: Annotated[Scope, typer.Option(help="What it may do.")] = Scope.SUBMIT,
    project: ProjectOption = "",
    expires: LifetimeOption = None,
    requests_per_minute: RequestsOption = None,
    concurrency: ConcurrencyOption = None,
    grasps_in_flight: GraspsOption = None,
    jobs_per_day: JobsOption = None,
    json: JsonFlag = False,
) -> None:
    """Make a key and show it, this once. Limits that are not given are those of the settings."""
    limits = _limits(requests_per_minute, concurrency, grasps_in_flight, jobs_per_day)
    lifetime = duration(expires) if expires else None
    token = _key_file().add(name, scope, lifetime=lifetime, limits=limits, project=project)
    _show_token(name, scope, token, json=json)


@app.command("rotate", epilog="graspd keys rotate alice --grace 24h")
@reporting_errors
def rotate_key(
    name: NameArgument,
    grace: Annotated[str, typer.Option(help="How long the old secret still opens: 24h, 7d; 0s: not at all.")] = "0s",
    expires: LifetimeOption = None,
    json: JsonFlag = False,
) -> None:
    """Give a key a new secret and show it, this once. Scope and limits stay."""
    keys = _key_file()
    token = keys.rotate(name, grace=duration(grace), lifetime=duration(expires) if expires else None)
    _show_token(name, next(key.scope for key in reversed(keys.list()) if key.name == name), token, json=json)


@app.command("limit", epilog="graspd keys limit alice --requests-per-minute 60 --jobs-per-day 100")
@reporting_errors
def limit_key(
    name: NameArgument,
    requests_per_minute: RequestsOption = None,
    concurrency: ConcurrencyOption = None,
    grasps_in_flight: GraspsOption = None,
    jobs_per_day: JobsOption = None,
    json: JsonFlag = False,
) -> None:
    """Change what a key may use; it counts from the next request on."""
    wanted = _limits(requests_per_minute, concurrency, grasps_in_flight, jobs_per_day)
    if not wanted.model_fields_set:
        raise InputError("give at least one limit, such as --jobs-per-day 100")
    limits = _key_file().limit(name, wanted)
    if json:
        emit({"name": name, "limits": limits.model_dump(exclude_none=True)})
        return
    typer.echo(f"limits of {name}: {_shown(limits)}")


@app.command("list", epilog="graspd keys list --json")
@reporting_errors
def list_keys(json: JsonFlag = False) -> None:
    """All keys, without their secrets."""
    found = _key_file().list()
    if json:
        emit({"keys": [key.model_dump(mode="json", exclude={"sha256"}) for key in found]})
        return
    has_projects = any(key.project for key in found)
    names = ["name", "scope", *(["project"] if has_projects else []), "state", "created", "expires", "limits"]
    table = plain_table(*names, whole=("state", "created", "expires"))
    for key in found:
        of = [key.project or "-"] if has_projects else []
        times = minute(key.created), minute(key.expires)
        table.add_row(key.name, key.scope, *of, _state(key), *times, _shown(key.limits))
    plain_console().print(table if found else "no key; the service is open and answers on this machine only")


@app.command("revoke", epilog="graspd keys revoke alice")
@reporting_errors
def revoke_key(name: NameArgument, json: JsonFlag = False) -> None:
    """End a key's life; it is refused from the next request on."""
    _key_file().revoke(name)
    if json:
        emit({"name": name, "revoked": True})
        return
    typer.echo(f"the key {name} is revoked")


def duration(text: str) -> timedelta:
    """A time such as 90d, 12h, 30m or 45s; InputError for anything else."""
    match = re.fullmatch(r"(\d{1,6})([smhd])", text.strip())
    if match is None:
        raise InputError(f"{text!r} is no length of time; write 90d, 12h, 30m or 45s")
    return timedelta(**{_UNITS[match[2]]: int(match[1])})


def _limits(requests: int | None, concurrency: int | None, grasps: int | None, jobs: int | None) -> KeyLimits:
    given = {
        "requests_per_minute": requests,
        "concurrency": concurrency,
        "grasps_in_flight": grasps,
        "jobs_per_day": jobs,
    }
    return KeyLimits(**{name: value for name, value in given.items() if value is not None})


def _show_token(name: str, scope: Scope, token: str, *, json: bool) -> None:
    if json:
        emit({"name": name, "scope": scope, "key": token})
        return
    typer.echo(token)
    typer.echo("This is the only time the key is shown. Send it as `Authorization: Bearer ...`.", err=True)


def _state(key: Key) -> str:
    if key.is_live:
        return "live"
    return f"revoked {key.revoked[:16]}" if key.revoked else "expired"


def _shown(limits: KeyLimits) -> str:
    found = limits.model_dump(exclude_none=True)
    return ", ".join(f"{value or 'no limit on'} {name.replace('_', ' ')}" for name, value in found.items()) or "default"


def _key_file() -> KeyFile:
    return KeyFile(load_settings().resolved_keys_file)
