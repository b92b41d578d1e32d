"""`graspd tags`: name grasps of the service, and export them by name."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from graspd.api.formatting import count, minute
from graspd.client.client import Client, request_path
from graspd.client.reports import ClientGroup, YesOption, delete, print_rows, restore
from graspd.service.cli import JsonFlag, print_result
from graspd.service.model.errors import InputError

app = ClientGroup(no_args_is_help=True, help="Tag grasps of the service; list and export tagged ones.")

#: Longest wait for the first byte while the service writes the file [s].
_PATIENCE_S: Final = 600.0

NameArgument = Annotated[str, typer.Argument(metavar="TAG", help="Name of the tag: `graspd tags list`.")]
GraspsArgument = Annotated[list[str] | None, typer.Argument(metavar="[SHARD:ROW]...", help="Grasps by shard and row.")]
WhereOption = Annotated[str | None, typer.Option(help="Only grasps that satisfy an expression: epsilon > 0.3.")]
JobOption = Annotated[str | None, typer.Option(help="Only grasps of this job.")]
DatasetOption = Annotated[str | None, typer.Option(help="Only grasps of this dataset.")]


@app.command("list", epilog="graspd tags list")
def list_tags(client: Client, json: JsonFlag = False) -> None:
    """List tags with their numbers of grasps."""
    found = client.send("GET", "/v1/tags").json()
    rows = [(one["name"], count(one["grasps"]), minute(one["changed"])) for one in found]
    names, empty = ("tag", "grasps", "changed"), "no tag yet; `graspd tags add TAG --where EXPRESSION` tags grasps"
    print_rows("tags", found, names, rows, whole=names[1:], empty=empty, json=json)


def change_command(verb: str, help: str, words: str, example: str) -> None:
    @app.command(verb, help=help, epilog=f"graspd tags {verb} good {example}")
    def change(
        client: Client,
        tag: NameArgument,
        grasps: GraspsArgument = None,
        where: WhereOption = None,
        job: JobOption = None,
        dataset: DatasetOption = None,
        json: JsonFlag = False,
    ) -> None:
        body, path = _selection(grasps, where=where, job=job, dataset=dataset), "/v1/tags"
        if verb == "add":
            body["name"] = tag
        else:
            path = request_path("tags", tag, "remove")
            if "filter" in body:
                body["filter"]["tag"] = tag
        made = client.send("POST", path, json=body).json()
        has = made["tag"]
        line = f"{count(made['changed'])} grasps {words} {has['name']}; {count(has['grasps'])} grasps have the tag"
        print_result(made, line, json=json)


change_command(
    "add",
    "Tag grasps; create the tag if it is new.",
    "tagged with",
    '--dataset kitchen --where "epsilon > 0.3 and lift"',
)
change_command("remove", "Remove a tag from grasps.", "removed from", '--where "penetration_depth_mm > 1"')


@app.command("delete", epilog="graspd tags delete good")
def delete_tag(client: Client, tag: NameArgument, yes: YesOption = False, json: JsonFlag = False) -> None:
    """Delete a tag; its grasps remain."""
    has = client.send("GET", request_path("tags", tag)).json()["grasps"]
    undo = f"graspd tags restore {shlex.quote(tag)}"
    delete(client, "tag", tag, f"Delete the tag {tag} of {count(has)} grasps?", yes=yes, json=json, undo=undo)


@app.command("restore", epilog="graspd tags restore good")
def restore_tag(client: Client, tag: NameArgument, json: JsonFlag = False) -> None:
    """Restore a deleted tag of grasps within the grace time."""
    restore(client, "tag", tag, json=json)


@app.command("export", epilog="graspd tags export good -o good.zip")
def export_tag(
    client: Client,
    tag: NameArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write: .zip (base shards), .csv or .json (rows).")],
    json: JsonFlag = False,
) -> None:
    """Export the grasps with a tag to a file."""
    format = out.suffix.removeprefix(".").lower()
    if format not in ("zip", "csv", "json"):
        raise InputError(f"{out}: the name of the file must end in .zip, .csv or .json")
    client.save("/v1/grasps/export", out, params={"tag": tag, "format": format}, patience_s=_PATIENCE_S)
    print_result({"tag": tag, "file": str(out), "bytes": out.stat().st_size}, str(out), json=json)


def _selection(grasps: list[str] | None, **filters: str | None) -> dict[str, Any]:
    given = {name: value for name, value in filters.items() if value is not None}
    if grasps and given:
        raise InputError("give SHARD:ROW, or --where, --job and --dataset, not both")
    if not grasps:
        if not given:
            raise InputError("select grasps: SHARD:ROW, or --where, --job, --dataset")
        return {"filter": given}
    places = [one.partition(":") for one in grasps]
    if wrong := next((one for one, (_, _, row) in zip(grasps, places, strict=True) if not row.isdigit()), None):
        raise InputError(f"{wrong!r} does not name a grasp; write SHARD:ROW")
    return {"grasps": [{"shard_id": shard, "row": int(row)} for shard, _, row in places]}
