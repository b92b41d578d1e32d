"""`graspd tags`: name grasps of the service, and export them by name."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from graspd.api.formatting import count, minute
from graspd.client.client import request_path
from graspd.client.reports import UrlOption, YesOption, confirm, open_client, print_rows, report_deletion, restore
from graspd.service.cli import CommandGroup, JsonFlag, print_result
from graspd.service.model.errors import InputError

app = CommandGroup(no_args_is_help=True, help="Tag grasps of the service; list and export tagged ones.")

#: Longest wait for the first byte while the service writes the file [s].
_PATIENCE_S: Final = 600.0

NameArgument = Annotated[str, typer.Argument(metavar="TAG", help="Name of the tag: `graspd tags list`.")]
GraspsArgument = Annotated[list[str] | None, typer.Argument(metavar="[SHARD:ROW]...", help="Grasps by shard and row.")]
WhereOption = Annotated[str | None, typer.Option(help="Only grasps that satisfy an expression: epsilon > 0.3.")]
JobOption = Annotated[str | None, typer.Option(help="Only grasps of this job.")]
DatasetOption = Annotated[str | None, typer.Option(help="Only grasps of this dataset.")]


@app.command("list", epilog="graspd tags list")
def list_tags(url: UrlOption = None, json: JsonFlag = False) -> None:
    """List tags with their numbers of grasps."""
    with open_client(url) as client:
        found = client.send("GET", "/v1/tags").json()
    rows = [(one["name"], count(one["grasps"]), minute(one["changed"])) for one in found]
    empty = "no tag yet; `graspd tags add TAG --where EXPRESSION` tags grasps"
    print_rows({"tags": found}, ("tag", "grasps", "changed"), rows, whole=("grasps", "changed"), empty=empty, json=json)


@app.command("add", epilog='graspd tags add good --dataset kitchen --where "epsilon > 0.3 and lift"')
def add_tag(
    tag: NameArgument,
    grasps: GraspsArgument = None,
    where: WhereOption = None,
    job: JobOption = None,
    dataset: DatasetOption = None,
    url: UrlOption = None,
    json: JsonFlag = False,
) -> None:
    """Tag grasps; create the tag if it is new."""
    body = {"name": tag, **_selection(grasps, where=where, job=job, dataset=dataset)}
    with open_client(url) as client:
        _report_change(client.send("POST", "/v1/tags", json=body).json(), "tagged with", json=json)


@app.command("remove", epilog='graspd tags remove good --where "penetration_depth_mm > 1"')
def remove_tag(
    tag: NameArgument,
    grasps: GraspsArgument = None,
    where: WhereOption = None,
    job: JobOption = None,
    dataset: DatasetOption = None,
    url: UrlOption = None,
    json: JsonFlag = False,
) -> None:
    """Remove a tag from grasps."""
    body = _selection(grasps, where=where, job=job, dataset=dataset)
    if "filter" in body:
        body["filter"]["tag"] = tag
    with open_client(url) as client:
        _report_change(
            client.send("POST", request_path("tags", tag, "remove"), json=body).json(), "removed from", json=json
        )


@app.command("delete", epilog="graspd tags delete good")
def delete_tag(tag: NameArgument, yes: YesOption = False, url: UrlOption = None, json: JsonFlag = False) -> None:
    """Delete a tag; its grasps remain."""
    path = request_path("tags", tag)
    with open_client(url) as client:
        has = client.send("GET", path).json()["grasps"]
        confirm(f"Delete the tag {tag} of {count(has)} grasps?", f"the tag {tag}", yes=yes)
        client.delete(path)
    report_deletion("tag", tag, json=json, undo=f"graspd tags restore {shlex.quote(tag)}")


@app.command("restore", epilog="graspd tags restore good")
def restore_tag(tag: NameArgument, url: UrlOption = None, json: JsonFlag = False) -> None:
    """Restore a deleted tag of grasps within the grace time."""
    restore(url, "tag", tag, json=json)


@app.command("export", epilog="graspd tags export good -o good.zip")
def export_tag(
    tag: NameArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write: .zip (base shards), .csv or .json (rows).")],
    url: UrlOption = None,
    json: JsonFlag = False,
) -> None:
    """Export the grasps with a tag to a file."""
    format = out.suffix.removeprefix(".").lower()
    if format not in ("zip", "csv", "json"):
        raise InputError(f"{out}: the name of the file must end in .zip, .csv or .json")
    with open_client(url) as client:
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


def _report_change(change: dict[str, Any], words: str, *, json: bool) -> None:
    tag = change["tag"]
    line = f"{count(change['changed'])} grasps {words} {tag['name']}; {count(tag['grasps'])} grasps have the tag"
    print_result(change, line, json=json)
