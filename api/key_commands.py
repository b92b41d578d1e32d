"""`graspd keys`: make, list and revoke API keys."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from api.auth import KeyFile, Scope
from service.cli import JsonFlag, emit, load_settings, reporting_errors

app = typer.Typer(no_args_is_help=True, help="Make, list and revoke API keys.")


@app.command("add")
@reporting_errors
def add_key(
    name: Annotated[str, typer.Argument(help="Whose key it is.")],
    scope: Annotated[Scope, typer.Option(help="What it may do.")] = Scope.SUBMIT,
    json: JsonFlag = False,
) -> None:
    """Make a key and show it, this once."""
    token = _key_file().add(name, scope)
    if json:
        emit({"name": name, "scope": scope, "key": token})
        return
    typer.echo(token)
    typer.echo("This is the only time the key is shown. Send it as `Authorization: Bearer ...`.", err=True)


@app.command("list")
@reporting_errors
def list_keys(json: JsonFlag = False) -> None:
    """All keys, without their secrets."""
    found = _key_file().list()
    if json:
        emit({"keys": [key.model_dump(mode="json", exclude={"sha256"}) for key in found]})
        return
    table = Table("name", "scope", "created", "revoked", box=None, header_style="bold")
    for key in found:
        table.add_row(key.name, key.scope, key.created, key.revoked or "")
    Console().print(table if found else "no key; the service is open and answers on this machine only")


@app.command("revoke")
@reporting_errors
def revoke_key(name: Annotated[str, typer.Argument(help="Whose key it is.")], json: JsonFlag = False) -> None:
    """End a key's life; it is refused from the next request on."""
    _key_file().revoke(name)
    if json:
        emit({"name": name, "revoked": True})
        return
    typer.echo(f"the key {name} is revoked")


def _key_file() -> KeyFile:
    return KeyFile(load_settings().data_dir / "keys.json")
