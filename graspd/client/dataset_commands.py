"""`graspd datasets`: datasets of hands x objects, from spec and cost estimate to export."""

from __future__ import annotations

import json
import math
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import Field, model_validator
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

from graspd.api.formatting import count, minute, percent, size
from graspd.client import reports
from graspd.client.add_commands import name_of_set, upload_set
from graspd.client.client import Client, request_path
from graspd.service.cli import CommandGroup, JsonFlag, plain_console, print_json, print_result
from graspd.service.command_options import parse_pairs, validate_options, with_options
from graspd.service.index.views import DatasetView
from graspd.service.model.base import Name, error_text
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError, TaskError, did_you_mean
from graspd.service.model.options import validate
from graspd.service.model.records import Snapshot
from graspd.service.model.scene_spec import check_object_name, parse_scene_option
from graspd.service.model.states import AssetKind, State
from graspd.service.pipeline.datasets.export import export_shards
from graspd.service.pipeline.datasets.spec import DatasetRequest, Estimate, Matrix
from graspd.service.store.assets import MAX_NAME
from graspd.service.store.object_sets import Objects, find_set_objects

SpecOption = Annotated[Path | None, typer.Option("--spec", help="TOML or JSON file; options take precedence.")]


class Spec(JobOptions):
    """Content of a `--spec` file."""

    SUBMITTED = True

    name: Name | None = None
    hands: tuple[Name, ...] = ()
    objects: str | tuple[str, ...] = Field((), description="as `--objects`; folders are relative to the spec")
    total_grasps: int | None = Field(None, ge=1, description="grasps over all cells, divided evenly")

    @model_validator(mode="after")
    def _check_grasps(self) -> Spec:
        if self.total_grasps is not None and "grasps" in self.model_fields_set:
            raise ValueError("total_grasps replaces grasps: give one of them")
        return self


@dataclass(frozen=True)
class DatasetPlan:
    name: str
    hands: str
    objects: str
    options: dict[str, Any]
    total: int | None = None

    def matrix_per_cell(self, matrix: dict[str, Any], objects: int) -> dict[str, Any]:
        """Return the matrix with grasps per cell; a total over all cells is divided and rounded up."""
        if self.total is None or not objects:
            return matrix
        return matrix | {"grasps": math.ceil(self.total / (len(matrix["hands"]) * objects))}


def dataset_plan(
    spec: Path | None, *, name: str | None, hands: str | None, objects: str | None, options: dict[str, Any]
) -> DatasetPlan:
    """Combine spec and options; options take precedence. The name is empty if neither has one."""
    given = dict(options)
    if "options" in given:
        given["options"] = parse_pairs(given["options"])
    if "scene" in given:
        given["scene"] = parse_scene_option(given["scene"])
    if "neighbours" in given:
        given["neighbours"] = [check_object_name(one) for one in given["neighbours"]]
    said = read_spec(spec) if spec is not None else {}
    total = None if "grasps" in given else said.pop("total_grasps", None)
    said.pop("total_grasps", None)
    found_name = name or said.pop("name", "")
    found_hands = hands or ",".join(said.get("hands", ()))
    found_objects = objects or _objects(spec, said.get("objects", ()))
    for what, found in (("hands", found_hands), ("objects", found_objects)):
        if not found:
            raise InputError(f"give the {what}: --{what}, or {what} in the file of --spec")
    rest = {key: value for key, value in said.items() if key not in ("name", "hands", "objects")}
    return DatasetPlan(found_name, found_hands, found_objects, {**rest, **given}, total)


def read_spec(file: Path) -> dict[str, Any]:
    """Return the keys of a spec; raise InputError if the file is invalid."""
    kind, load = ("JSON", json.loads) if file.suffix == ".json" else ("TOML", tomllib.loads)
    try:
        found = load(file.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file} cannot be read: {error_text(error)}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file} is no {kind}: {error}") from None
    if not isinstance(found, dict):
        raise InputError(f"{file} must contain the keys of a dataset: hands, objects, grasps, ...")
    try:
        if isinstance(found.get("scene"), str):
            found["scene"] = parse_scene_option(found["scene"], beside=file.parent)
        if isinstance(beside := found.get("neighbours"), list):
            found["neighbours"] = [check_object_name(one) if isinstance(one, str) else one for one in beside]
        spec = validate(Spec, found)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    return spec.model_dump(mode="json", exclude_unset=True)


def _objects(spec: Path | None, said: Any) -> str:
    if not isinstance(said, str):
        return ",".join(said)
    path = spec.parent / said if spec is not None else Path(said)
    return str(path) if "/" in said and path.exists() else said


app = CommandGroup(no_args_is_help=True)
group = reports.ClientGroup(no_args_is_help=True, help="Datasets of hands x objects: cost, status, snapshots, files.")
app.add_typer(group, name="datasets")

NameArgument = Annotated[str, typer.Argument(help="Name of the dataset.")]
HandsOption = Annotated[str | None, typer.Option("--hands", help="Names of hands: allegro,shadow.")]
ObjectsOption = Annotated[str | None, typer.Option("--objects", help="Objects or sets: mug,ycb; or folder to upload.")]
WaitOption = Annotated[bool, typer.Option("--wait", help="Show progress until the dataset ends.")]


@group.command(epilog="graspd datasets create kitchen --hands allegro,shadow --objects ./ycb --grasps 1000")
@with_options(JobOptions, "job")
def create(
    client: Client,
    name: Annotated[str | None, typer.Argument(help="Name of the dataset; default: the name in the spec.")] = None,
    hands: HandsOption = None,
    objects: ObjectsOption = None,
    spec: SpecOption = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Start without confirmation.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the estimated cost and exit.")] = False,
    wait: WaitOption = False,
    json: JsonFlag = False,
    *,
    options: dict[str, Any],
) -> None:
    """Make a dataset with a job for each hand and object. The same command continues it later."""
    console = plain_console(stderr=json)
    asked = dataset_plan(spec, name=name, hands=hands, objects=objects, options=options)
    if not asked.name:
        raise InputError("give a name: graspd datasets create NAME, or name in the file of --spec")
    files, matrix = _matrix(client, asked)
    request = validate_options(DatasetRequest, {"name": asked.name, **matrix})
    found = _estimate(client, matrix, files)
    shown = found.model_dump(mode="json")
    reports.print_estimate(found, console)
    if dry_run:
        if json:
            print_json({"estimate": shown})
        return
    if not yes and not sys.stdin.isatty():
        raise InputError("give --yes to start it, or --dry-run for the cost alone")
    if not yes and not typer.confirm("Start it?"):
        raise InputError("nothing was started")
    refused: list[str] = []
    if files is not None:
        refused = _upload(client, files, name_of_set(Path(asked.objects)), console)
        matrix = asked.matrix_per_cell(matrix, len(files) - len(refused))
        request = validate_options(DatasetRequest, {"name": asked.name, **matrix, "objects": []})
    dataset = client.create_dataset(request)
    if wait:
        dataset = reports.watch_dataset(client, asked.name, plain_console(stderr=True))
    if json:
        print_json({"estimate": shown, "dataset": dataset.model_dump(mode="json"), "refused": refused})
    else:
        if refused:
            console.print(f"refused, so not in the dataset: {', '.join(refused)}", soft_wrap=True)
        reports.print_dataset(dataset, console)
        console.print(f"`graspd datasets status {asked.name}` shows each cell", style="dim")
    _check_success(dataset, asked=wait)


@group.command(epilog="graspd datasets estimate --hands allegro --objects mug --grasps 1000000 --scenes 2 --views 3")
@with_options(JobOptions, "job")
def estimate(
    client: Client,
    hands: HandsOption = None,
    objects: ObjectsOption = None,
    spec: SpecOption = None,
    json: JsonFlag = False,
    *,
    options: dict[str, Any],
) -> None:
    """Estimate the cost of a dataset: storage, and time and traffic for 1, 8 and 64 workers."""
    asked = dataset_plan(spec, name=None, hands=hands, objects=objects, options=options)
    files, matrix = _matrix(client, asked)
    found = _estimate(client, matrix, files)
    if json:
        print_json(found)
    else:
        reports.print_estimate(found, plain_console())


@group.command("list", epilog="graspd datasets list")
def list_datasets(
    client: Client,
    limit: Annotated[int, typer.Option(min=1, max=200, help="Maximum number of datasets.")] = 20,
    json: JsonFlag = False,
) -> None:
    """List datasets, newest first."""
    page = client.datasets(limit=limit)
    rows = []
    for one in page.items:
        made = f"{count(one.counted_grasps)} {one.options.displayed_status} of {count(one.asked)}"
        last = (percent(one.progress), made, size(one.size_bytes), minute(one.created))
        rows.append((one.name, one.state, count(one.cells), *last))
    names = ("dataset", "state", "cells", "progress", "grasps", "size", "created")
    empty = "no dataset yet; `graspd datasets create NAME --hands allegro --objects mug,bottle` makes one"
    whole = ("state", "size", "created")
    reports.print_rows("datasets", page.items, names, rows, whole=whole, empty=empty, json=json, next=page.next)


@group.command(epilog="graspd datasets status kitchen --state failed")
def status(
    client: Client,
    name: NameArgument,
    state: Annotated[State | None, typer.Option(help="Only cells in this state.")] = None,
    json: JsonFlag = False,
) -> None:
    """Show the matrix: state, yield and failures of each hand and object."""
    dataset, cells = client.dataset(name), list(client.cells(name, state=state))
    if json:
        print_json({**dataset.model_dump(mode="json"), "matrix": [cell.model_dump(mode="json") for cell in cells]})
        return
    reports.print_dataset(dataset, plain_console())
    reports.print_cells(dataset, cells, plain_console())


@group.command(epilog="graspd datasets cancel kitchen")
def cancel(client: Client, name: NameArgument, json: JsonFlag = False) -> None:
    """Cancel a dataset; its results remain."""
    _show(client.request(DatasetView, "POST", request_path("datasets", name, "cancel")), json=json)


@group.command(epilog="graspd datasets delete kitchen")
def delete(
    client: Client,
    name: NameArgument,
    yes: reports.YesOption = False,
    with_snapshots: Annotated[bool, typer.Option("--with-snapshots", help="Also delete its snapshots.")] = False,
    json: JsonFlag = False,
) -> None:
    """Delete an ended dataset, and the jobs that belong to it alone."""
    found = client.dataset(name)
    goes = f"{count(found.cells)} cell{'s' * (found.cells != 1)}, {count(found.grasps)} grasps"
    goes += f" ({size(found.size_bytes)})" + ", its snapshots" * with_snapshots
    question, undo = f"Delete dataset {name} with {goes}?", f"graspd datasets restore {name}"
    reports.delete(client, "dataset", name, question, yes=yes, json=json, undo=undo, with_snapshots=with_snapshots)


@group.command("restore", epilog="graspd datasets restore kitchen")
def restore_dataset(client: Client, name: NameArgument, json: JsonFlag = False) -> None:
    """Restore a deleted dataset with its jobs and snapshots, within the grace time."""
    reports.restore(client, "dataset", name, json=json)


@group.command(epilog="graspd datasets retry kitchen --wait")
def retry(client: Client, name: NameArgument, wait: WaitOption = False, json: JsonFlag = False) -> None:
    """Restart failed and cancelled jobs; existing results are reused."""
    dataset = client.request(DatasetView, "POST", request_path("datasets", name, "retry"))
    if wait:
        dataset = reports.watch_dataset(client, name, plain_console(stderr=True))
    _show(dataset, json=json)
    _check_success(dataset, asked=wait)


@group.command(epilog="graspd datasets snapshot kitchen")
def snapshot(client: Client, name: NameArgument, json: JsonFlag = False) -> None:
    """Record the present shards of a dataset as an immutable list."""
    taken = client.take_snapshot(name)
    whole = "complete" if taken.complete else "the dataset is not complete"
    grasps = f"{count(taken.grasps)} grasps of which {count(taken.valid)} are valid"
    line = f"{taken.digest}  {count(taken.shards)} shards, {grasps}, {size(taken.size_bytes)}; {whole}"
    print_result(taken, line, json=json)


@group.command(epilog="graspd datasets export kitchen -o kitchen-v1 --snapshot 3f2a...")
def export(
    client: Client,
    name: NameArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write; an interrupted export is continued.")],
    snapshot: Annotated[str | None, typer.Option(help="Digest of a snapshot; default: all present shards.")] = None,
    json: JsonFlag = False,
) -> None:
    """Write a snapshot's files into a folder; each is verified against its checksum."""
    label, counts = TextColumn("{task.description}", markup=False), TextColumn("{task.fields[files]}")
    columns = (label, BarColumn(), counts, DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    digest = snapshot or client.take_snapshot(name).digest
    taken = client.request(Snapshot, "GET", request_path("datasets", name, "snapshots", digest))
    console = plain_console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task(name, total=taken.size_bytes, files="")
        fetched = export_shards(
            taken,
            out,
            lambda shard: client.fetch(request_path("shards", shard.id, "file")),
            lambda done, files, fetched: progress.update(bar, completed=fetched, files=f"{done}/{files}"),
        )
    told = {"dataset": name, "snapshot": taken.digest, "out": str(out), "files": len(taken.shards), "fetched": fetched}
    line = f"{out}: {count(len(taken.shards))} files, {size(taken.size_bytes)}, snapshot {taken.digest}"
    print_result({**told, "bytes": taken.size_bytes, "complete": taken.complete}, line, json=json)


def _matrix(client: Client, asked: DatasetPlan) -> tuple[Objects | None, dict[str, Any]]:
    objects = asked.objects
    names = [word.strip() for word in objects.split(",") if word.strip()]
    matrix: dict[str, Any] = {"hands": [w.strip() for w in asked.hands.split(",") if w.strip()], **asked.options}
    known = {found.name: found.objects for found in client.object_sets()}
    path = Path(objects)
    # A bare name means the known set, even if a folder of that name exists; ./NAME is the folder. Long lists of names
    # are no paths.
    may_be_path = objects not in known and ("/" in objects or len(objects) <= MAX_NAME)
    if may_be_path and (files := find_set_objects(path)):
        matrix |= {"objects": sorted(files), "sets": [name_of_set(path)]}
        return files, asked.matrix_per_cell(matrix, len(files))
    if may_be_path and path.is_file():
        raise InputError(f"{objects} is one object; run `graspd objects add {objects}`, then give its name here")
    if "/" in objects:
        raise InputError(f"there is no folder {objects}; give one that exists, or names of objects and sets")
    single = [name for name in names if name not in known]
    matrix |= {"objects": single, "sets": [name for name in names if name in known]}
    members = {*single, *(member for name in names for member in known.get(name, ()))}
    return None, asked.matrix_per_cell(matrix, len(members))


def _estimate(client: Client, matrix: dict[str, Any], files: Objects | None) -> Estimate:
    """Return the cost; raise InputError for unknown names, except names of files to upload."""
    asked = matrix | {"sets": []} if files is not None else matrix
    found = client.estimate(validate_options(Matrix, asked))
    if unknown := [name for name in found.unknown if name not in (files or {})]:
        known = [one.name for kind in (AssetKind.HAND, AssetKind.OBJECT) for one in client.assets(kind)]
        fix = f"`graspd hands list` and `graspd objects list` show the known ones{did_you_mean(unknown[0], known)}"
        raise InputError(f"there is no hand or object {', '.join(map(repr, unknown[:5]))}; {fix}")
    return found


def _upload(client: Client, files: Objects, set_name: str, console: Console) -> list[str]:
    """Upload the objects of a folder as a set without refused objects; return the refused ones."""
    told = upload_set(client, files, set_name, say=lambda line: console.print(line, soft_wrap=True))
    refused = [one["name"] for one in told if one["verdict"] == "refuse"]
    if len(refused) == len(told):
        raise InputError(f"none of the {len(told)} objects can be used; reasons are above")
    return refused


def _show(dataset: DatasetView, *, json: bool) -> None:
    if json:
        print_json(dataset)
    else:
        reports.print_dataset(dataset, plain_console())


def _check_success(dataset: DatasetView, *, asked: bool) -> None:
    if asked and dataset.state in (State.FAILED, State.CANCELLED):
        fix = f"`graspd datasets retry {dataset.name}` runs it again"
        raise TaskError(f"dataset {dataset.name} is {dataset.state.value}; {fix}")
