"""`graspd webhooks`: addresses that are told when jobs and datasets end."""

from __future__ import annotations

from typing import Annotated

import typer

from api.client.client import path_of
from api.client.reports import UrlOption, YesOption, confirm, open_client, say_deleted
from api.formatting import minute
from service.cli import JsonFlag, emit, plain_console, plain_table, reporting_errors

app = typer.Typer(no_args_is_help=True, help="Addresses that are told when jobs and datasets end.")

IdArgument = Annotated[str, typer.Argument(metavar="ID", help="Of the webhook: `graspd webhooks list`.")]


@app.command("add", epilog="graspd webhooks add https://ci.example.org/graspd --on succeeded,failed")
@reporting_errors
def add_webhook(
    address: Annotated[str, typer.Argument(help="Where to POST: https://host/path.")],
    on: Annotated[str, typer.Option(help="Ends to tell, with commas.")] = "succeeded,failed,cancelled",
    url: UrlOption = None,
    json: JsonFlag = False,
) -> None:
    """Tell an address of ends from now on, and show the secret that signs what is sent, this once."""
    states = [one.strip() for one in on.split(",") if one.strip()]
    with open_client(url) as client:
        made = client.send("POST", "/v1/webhooks", json={"url": address, "states": states}).json()
    if json:
        emit(made)
        return
    typer.echo(made["secret"])
    typer.echo(f"webhook {made['id']}. This is the only time its secret is shown.", err=True)


@app.command("list", epilog="graspd webhooks list")
@reporting_errors
def list_webhooks(url: UrlOption = None, json: JsonFlag = False) -> None:
    """Webhooks that the key may change."""
    with open_client(url) as client:
        found = client.send("GET", "/v1/webhooks").json()
    if json:
        emit({"webhooks": found})
        return
    table = plain_table("id", "address", "on", "since", whole=("id", "since"))
    for one in found:
        table.add_row(one["id"], one["url"], ", ".join(one["states"]), minute(one["created"]))
    plain_console().print(table if found else "no webhook yet; `graspd webhooks add URL` makes one")


@app.command("log", epilog="graspd webhooks log 1a2b3c")
@reporting_errors
def show_log(webhook: IdArgument, url: UrlOption = None, json: JsonFlag = False) -> None:
    """What became of telling it, the newest first."""
    with open_client(url) as client:
        found = client.send("GET", path_of("webhooks", webhook, "deliveries")).json()
    if json:
        emit({"deliveries": found})
        return
    table = plain_table("what", "ended", "delivery", "attempts", "last", "", whole=("ended", "delivery", "last"))
    for one in found:
        what = f"{one['kind']} {one['subject'][:12] if one['kind'] == 'job' else one['subject']}"
        tried = (str(one["attempts"]), minute(one["tried"]))
        table.add_row(what, one["ended"], one["state"], *tried, one["detail"])
    plain_console().print(table if found else "nothing was to be told yet")


@app.command("delete", epilog="graspd webhooks delete 1a2b3c")
@reporting_errors
def delete_webhook(webhook: IdArgument, yes: YesOption = False, url: UrlOption = None, json: JsonFlag = False) -> None:
    """Tell it nothing any more. Its secret is gone for good."""
    with open_client(url) as client:
        confirm(f"Delete the webhook {webhook} and its secret for good?", f"the webhook {webhook}", yes=yes)
        client.delete(path_of("webhooks", webhook))
    say_deleted("webhook", webhook, json=json)
