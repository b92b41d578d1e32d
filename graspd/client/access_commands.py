"""`graspd keys`, `graspd projects` and `graspd webhooks`: access, limits and notifications."""

from __future__ import annotations

import re
from datetime import timedelta
from typing import Annotated, Any, Final

import typer

from graspd.api.access.keys import KeyFile, KeyLimits, ProjectLimits, Scope
from graspd.api.formatting import minute
from graspd.client.client import Client, request_path
from graspd.client.reports import ClientGroup, YesOption, delete, print_rows
from graspd.service.cli import CommandGroup, JsonFlag, load_settings, print_result
from graspd.service.command_options import with_options
from graspd.service.model.errors import InputError

keys_app = CommandGroup(no_args_is_help=True, help="Make, list, rotate, limit and revoke API keys.")

_UNITS: Final = {"s": "seconds", "m": "minutes", "h": "hours", "d": "days"}

NameArgument = Annotated[str, typer.Argument(help="Name of the key.")]
ProjectOption = Annotated[str, typer.Option(help="Project of the key; its resources are private.", metavar="NAME")]
LifetimeOption = Annotated[str | None, typer.Option("--expires", help="Lifetime: 90d or 12h; default: unlimited.")]


@keys_app.command("add", epilog="graspd keys add alice --scope submit --expires 90d --grasps-in-flight 100000")
@with_options(KeyLimits, "limit")
def add_key(
    name: NameArgument,
    scope: Annotated[Scope, typer.Option(help="Scope of the key.")] = Scope.SUBMIT,
    project: ProjectOption = "",
    expires: LifetimeOption = None,
    *,
    options: dict[str, Any],
    json: JsonFlag = False,
) -> None:
    """Make a key and show it once. Default limits are those of the settings."""
    lifetime = parse_duration(expires) if expires else None
    token = _key_file().add(name, scope, lifetime=lifetime, limits=KeyLimits(**options), project=project)
    _show_token(name, scope, token, json=json)


@keys_app.command("rotate", epilog="graspd keys rotate alice --grace 24h")
def rotate_key(
    name: NameArgument,
    grace: Annotated[str, typer.Option(help="Time for which the old secret remains valid: 24h, 7d; 0s: none.")] = "0s",
    expires: LifetimeOption = None,
    json: JsonFlag = False,
) -> None:
    """Replace the secret of a key and show it once; scope, project and limits do not change."""
    keys = _key_file()
    token = keys.rotate(name, grace=parse_duration(grace), lifetime=parse_duration(expires) if expires else None)
    _show_token(name, next(key.scope for key in reversed(keys.list()) if key.name == name), token, json=json)


@keys_app.command("limit", epilog="graspd keys limit alice --requests-per-minute 60 --jobs-per-day 100")
@with_options(KeyLimits, "limit")
def limit_key(name: NameArgument, *, options: dict[str, Any], json: JsonFlag = False) -> None:
    """Change the limits of a key, from the next request on."""
    _report_limits(
        "name", name, _key_file().set_limits(name, KeyLimits(**_given(options, "--jobs-per-day 100"))), json=json
    )


@keys_app.command("list", epilog="graspd keys list --json")
def list_keys(json: JsonFlag = False) -> None:
    """List all keys, without their secrets."""
    found = _key_file().list()
    has_projects = any(key.project for key in found)
    names = ["name", "scope", *(["project"] if has_projects else []), "state", "created", "expires", "limits"]
    rows = []
    for key in found:
        project = [key.project or "-"] if has_projects else []
        state = "live" if key.is_live else f"revoked {key.revoked[:16]}" if key.revoked else "expired"
        times = minute(key.created), minute(key.expires)
        rows.append((key.name, key.scope, *project, state, *times, _limits_text(key.limits)))
    empty = "no key; the service answers only this machine"
    told = [key.model_dump(mode="json", exclude={"sha256"}) for key in found]
    print_rows("keys", told, names, rows, whole=("state", "created", "expires"), empty=empty, json=json)


@keys_app.command("revoke", epilog="graspd keys revoke alice")
def revoke_key(name: NameArgument, json: JsonFlag = False) -> None:
    """Revoke a key; it is refused from the next request on."""
    _key_file().revoke(name)
    print_result({"name": name, "revoked": True}, f"the key {name} is revoked", json=json)


def parse_duration(text: str) -> timedelta:
    """Parse a time such as 90d, 12h, 30m or 45s; raise InputError for any other text."""
    match = re.fullmatch(r"(\d{1,6})([smhd])", text.strip())
    if match is None:
        raise InputError(f"{text!r} is not a duration; write 90d, 12h, 30m or 45s")
    return timedelta(**{_UNITS[match[2]]: int(match[1])})


def _show_token(name: str, scope: Scope, token: str, *, json: bool) -> None:
    print_result({"name": name, "scope": scope, "key": token}, token, json=json)
    if not json:
        typer.echo("This is the only time the key is shown. Send it as `Authorization: Bearer ...`.", err=True)


def _key_file() -> KeyFile:
    return KeyFile(load_settings().resolved_keys_file)


projects_app = CommandGroup(no_args_is_help=True, help="List projects of keys and set their limits.")


@projects_app.command("list", epilog="graspd projects list --json")
def list_projects(json: JsonFlag = False) -> None:
    """List projects of keys, and their limits. `graspd keys add NAME --project PROJECT` makes one."""
    file = _key_file()
    live: dict[str, list[str]] = {}
    for key in file.list():
        if key.is_live and key.name not in live.setdefault(key.project, []):
            live[key.project].append(key.name)
    found = file.projects()
    projects, rows = [], []
    for name, limits in found.items():
        keys = live.get(name, [])
        projects.append({"project": name, "keys": keys, "limits": limits.model_dump(exclude_none=True)})
        rows.append((name, ", ".join(keys) or "no valid key", _limits_text(limits)))
    empty = "no project yet; `graspd keys add NAME --project PROJECT` makes one"
    print_rows("projects", projects, ("project", "keys", "limits"), rows, empty=empty, json=json)


@projects_app.command("limit", epilog="graspd projects limit vision --gpu-seconds-per-day 86400")
@with_options(ProjectLimits, "limit")
def limit_project(
    name: Annotated[str, typer.Argument(help="Name of the project.")],
    *,
    options: dict[str, Any],
    json: JsonFlag = False,
) -> None:
    """Change the shared limits of a project's keys, from the next submission on."""
    _report_limits(
        "project",
        name,
        _key_file().limit_project(name, ProjectLimits(**_given(options, "--grasps-per-day 1000000"))),
        json=json,
    )


def _given(limits: dict[str, Any], example: str) -> dict[str, Any]:
    if not limits:
        raise InputError(f"give at least one limit, such as {example}")
    return limits


def _report_limits(what: str, name: str, limits: KeyLimits | ProjectLimits, *, json: bool) -> None:
    document = {what: name, "limits": limits.model_dump(exclude_none=True)}
    print_result(document, f"limits of {name}: {_limits_text(limits)}", json=json)


def _limits_text(limits: KeyLimits | ProjectLimits) -> str:
    """Return limits in words: of a key those that differ from the settings, of a project those that hold."""
    of_key = isinstance(limits, KeyLimits)
    found = limits.model_dump(exclude_none=True)
    texts = [
        f"{number or 'no limit on'} {name.replace('_', ' ')}" for name, number in found.items() if of_key or number
    ]
    return ", ".join(texts) or ("default" if of_key else "none")


webhooks_app = ClientGroup(no_args_is_help=True, help="Notify URLs when jobs and datasets end.")

IdArgument = Annotated[str, typer.Argument(metavar="ID", help="Id of the webhook, from `graspd webhooks list`.")]


@webhooks_app.command("add", epilog="graspd webhooks add https://ci.example.org/graspd --on succeeded,failed")
def add_webhook(
    client: Client,
    address: Annotated[str, typer.Argument(help="URL that receives the POST requests: https://host/path.")],
    on: Annotated[str, typer.Option(help="Final states, separated by commas.")] = "succeeded,failed,cancelled",
    json: JsonFlag = False,
) -> None:
    """Notify a URL when jobs and datasets end. The secret that signs notifications is shown once."""
    states = [one.strip() for one in on.split(",") if one.strip()]
    made = client.send("POST", "/v1/webhooks", json={"url": address, "states": states}).json()
    print_result(made, made["secret"], json=json)
    if not json:
        typer.echo(f"webhook {made['id']}. This is the only time its secret is shown.", err=True)


@webhooks_app.command("list", epilog="graspd webhooks list")
def list_webhooks(client: Client, json: JsonFlag = False) -> None:
    """List webhooks that the key may change."""
    found = client.send("GET", "/v1/webhooks").json()
    rows = [(one["id"], one["url"], ", ".join(one["states"]), minute(one["created"])) for one in found]
    names, empty = ("id", "address", "on", "since"), "no webhook yet; `graspd webhooks add URL` makes one"
    print_rows("webhooks", found, names, rows, whole=("id", "since"), empty=empty, json=json)


@webhooks_app.command("log", epilog="graspd webhooks log 1a2b3c")
def show_log(client: Client, webhook: IdArgument, json: JsonFlag = False) -> None:
    """List deliveries of a webhook, newest first."""
    found = client.send("GET", request_path("webhooks", webhook, "deliveries")).json()
    rows = []
    for one in found:
        what = f"{one['kind']} {one['subject'][:12] if one['kind'] == 'job' else one['subject']}"
        rows.append((what, one["ended"], one["state"], str(one["attempts"]), minute(one["tried"]), one["detail"]))
    names, whole = ("what", "ended", "delivery", "attempts", "last", ""), ("ended", "delivery", "last")
    print_rows("deliveries", found, names, rows, whole=whole, empty="no delivery yet", json=json)


@webhooks_app.command("delete", epilog="graspd webhooks delete 1a2b3c")
def delete_webhook(client: Client, webhook: IdArgument, yes: YesOption = False, json: JsonFlag = False) -> None:
    """Delete a webhook and its secret."""
    question = f"Delete the webhook {webhook} and its secret for good?"
    delete(client, "webhook", webhook, question, yes=yes, json=json)
