"""Commands that use the API over HTTP: jobs, hands, objects and networks."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from graspd.api.formatting import count, minute, percent, size
from graspd.api.models import JobDetail
from graspd.api.uploads import MAIN_SUFFIXES
from graspd.client import access_commands, reports, tag_commands
from graspd.client.add_commands import add_hand, add_network, add_object, upload_file
from graspd.client.client import Client, request_path
from graspd.service.cli import JsonFlag, plain_console, print_json
from graspd.service.command_options import parse_pairs, validate_options, with_options
from graspd.service.model.domain import NETWORK_METHODS, JobOptions, JobRequest
from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import parse_scene_option
from graspd.service.model.states import AssetKind, State
from graspd.service.store.asset_summary import hand_line, self_test_line

app = reports.ClientGroup(no_args_is_help=True)

JobArgument = Annotated[str, typer.Argument(help="Job id, or a prefix of it.")]
WaitOption = Annotated[bool, typer.Option("--wait", help="Show progress until the job ends.")]
AssetArgument = Annotated[str, typer.Argument(help="Name or digest of the asset.")]


@app.command(epilog="graspd submit --hand allegro --object mug.stl --grasps 320 --scenes 2 --views 3 --wait")
@with_options(JobOptions, "job")
def submit(
    client: Client,
    hand: Annotated[str, typer.Option(help="Name of a hand, or a URDF or ZIP to upload.")],
    object: Annotated[str, typer.Option(help="Name of an object, or a mesh file to upload.")],
    options: dict[str, Any],
    wait: WaitOption = False,
    json: JsonFlag = False,
) -> None:
    """Submit a job: one hand on one object."""
    object_name = partial(_asset_name, client, AssetKind.OBJECT)
    own = parse_pairs(options.get("options", ()))
    if options.get("method") in NETWORK_METHODS and "network" in own:
        own["network"] = _asset_name(client, AssetKind.NETWORK, str(own["network"]))
    options |= {
        "hand": _asset_name(client, AssetKind.HAND, hand),
        "object": object_name(object),
        "options": own,
        "scene": parse_scene_option(options.get("scene", "free"), named=object_name),
        "neighbours": [object_name(one) for one in options.get("neighbours", ())],
    }
    request = validate_options(JobRequest, options)
    job = client.submit(request)
    if wait:
        job = reports.watch(client, job.id)
    reports.show_job(job, json=json, url=client.url)


@app.command(epilog="graspd jobs --state running")
def jobs(
    client: Client,
    state: Annotated[State | None, typer.Option(help="Only jobs in this state.")] = None,
    limit: Annotated[int, typer.Option(min=1, max=200, help="Maximum number of jobs.")] = 20,
    json: JsonFlag = False,
) -> None:
    """List jobs, newest first."""
    page = client.jobs(state=state, limit=limit)
    rows = []
    for job in page.items:
        made = job.valid if job.standing == "valid" else job.grasps
        done = f"{count(made)} of {count(job.requested)} {job.standing}"
        last = (percent(job.progress), done, minute(job.created))
        rows.append((job.id[:12], job.state, job.hand, job.object, *last))
    names = ("job", "state", "hand", "object", "progress", "grasps", "created")
    empty = "no job yet; `graspd submit --hand allegro --object mug` makes one"
    whole = ("job", "state", "created")
    reports.print_rows("jobs", page.items, names, rows, whole=whole, empty=empty, json=json, next=page.next)


@app.command(epilog="graspd status 3f2a --json")
def status(client: Client, job_id: JobArgument, json: JsonFlag = False) -> None:
    """Show stages, progress and quality of a job."""
    reports.show_job(client.job(_full_id(client, job_id)), json=json, url=client.url, must_succeed=False)


@app.command(epilog="graspd cancel 3f2a")
def cancel(client: Client, job_id: JobArgument, json: JsonFlag = False) -> None:
    """Cancel a job; its results remain."""
    reports.show_job(_change_job(client, job_id, "cancel"), json=json, url=client.url, must_succeed=False)


@app.command(epilog="graspd delete 3f2a")
def delete(client: Client, job_id: JobArgument, yes: reports.YesOption = False, json: JsonFlag = False) -> None:
    """Delete an ended job. Shards that no other job uses are deleted after a grace time."""
    job = client.job(_full_id(client, job_id))
    asked = f"Delete job {job.id[:12]}, {job.hand} on {job.object}, with its {count(job.grasps)} grasps?"
    reports.delete(client, "job", job.id, asked, yes=yes, json=json, undo=f"graspd restore {job.id[:12]}")


@app.command("restore", epilog="graspd restore 3f2a")
def restore_job(
    client: Client,
    job_id: Annotated[str, typer.Argument(help="Id of a deleted job, or a prefix of it.")],
    json: JsonFlag = False,
) -> None:
    """Restore a deleted job, within the grace time."""
    gone = [one["id"] for one in client.send("GET", "/v1/deletions").json() if one["what"] == "job"]
    reports.restore(client, "job", _unique_id(gone, job_id), json=json)


@app.command(epilog="graspd retry 3f2a --wait")
def retry(client: Client, job_id: JobArgument, wait: WaitOption = False, json: JsonFlag = False) -> None:
    """Run failed and cancelled tasks of a job again; existing results are reused."""
    job = _change_job(client, job_id, "retry")
    if wait:
        job = reports.watch(client, job.id)
    reports.show_job(job, json=json, url=client.url)


@app.command(epilog="graspd logs 3f2a")
def logs(client: Client, job_id: JobArgument, json: JsonFlag = False) -> None:
    """Show failed attempts of a job with their reasons."""
    job = client.job(_full_id(client, job_id))
    if json:
        print_json({"job": job.id, "attempts": [attempt.model_dump(mode="json") for attempt in job.attempts]})
        return
    console = plain_console()
    if not job.attempts:
        console.print("no attempt has failed")
    for attempt in job.attempts:
        console.print(f"{attempt.ended}  task {attempt.task_id[:8]}  attempt {attempt.number}  {attempt.worker}")
        console.print(f"    {attempt.kind}: {attempt.reason}")
        if attempt.trace:
            console.print("\n".join("    " + line for line in attempt.trace.splitlines()), style="dim")


def asset_commands(kind: AssetKind) -> typer.Typer:
    """Create `graspd hands ...`, `graspd objects ...` or `graspd networks ...`."""
    verbs = "Add, list, show and delete" if kind is AssetKind.NETWORK else "Check, add, list, show and delete"
    group = reports.ClientGroup(no_args_is_help=True, help=f"{verbs} {kind.value}s.")

    @group.command("list", help=f"List {kind.value}s, by default without refused ones.")
    def list_assets(
        client: Client,
        refused: Annotated[bool, typer.Option("--refused", help="Include refused ones.")] = False,
        json: JsonFlag = False,
    ) -> None:
        assets = list(client.assets(kind, refused=refused))
        # All networks have the same file name, so their hand is shown instead.
        is_network, rows = kind is AssetKind.NETWORK, []
        for asset in assets:
            origin = "built-in" if asset.builtin else (asset.verdict or "waiting")
            if says := self_test_line(asset.facts):
                origin += f"; {says}"
            second = hand_line(asset.facts) if is_network else asset.filename
            rows.append((asset.name, second, size(asset.size_bytes), origin, asset.digest[:12]))
        names = ("name", "hand" if is_network else "file", "size", "check", "digest")
        reports.print_rows(f"{kind.value}s", assets, names, rows, whole=("size", "digest"), json=json)

    @group.command("show", help=f"Show a {kind.value} with the findings of its check.")
    def show(client: Client, name: AssetArgument, json: JsonFlag = False) -> None:
        reports.show_asset(client.asset(kind, name).model_dump(mode="json"), json=json)

    @group.command(
        "delete",
        help=f"Delete a {kind.value} that no job, dataset or set of objects uses.",
        epilog=f"graspd {kind.value}s delete my_{kind.value}",
    )
    def delete_asset(
        client: Client, name: AssetArgument, yes: reports.YesOption = False, json: JsonFlag = False
    ) -> None:
        client.asset(kind, name)
        question, undo = f"Delete the {kind.value} {name}?", f"graspd {kind.value}s restore {name}"
        reports.delete(client, kind.value, name, question, yes=yes, json=json, undo=undo)

    @group.command(
        "restore",
        help=f"Restore a deleted {kind.value} within the grace time.",
        epilog=f"graspd {kind.value}s restore my_{kind.value}",
    )
    def restore_asset(client: Client, name: AssetArgument, json: JsonFlag = False) -> None:
        reports.restore(client, kind.value, name, json=json)

    return group


hands_app, objects_app, networks_app = map(asset_commands, AssetKind)
hands_app.command("add", epilog="graspd hands add my_hand.zip --palm base_link --approach 0,0,1")(add_hand)
objects_app.command("add", epilog="graspd objects add banana.stl --units mm --density 950")(add_object)
networks_app.command("add", epilog="graspd networks add barrett.npz")(add_network)


@objects_app.command("sets", epilog="graspd objects sets")
def sets(client: Client, json: JsonFlag = False) -> None:
    """List sets of objects; `graspd objects add FOLDER` makes one."""
    found = client.object_sets()
    shown = [", ".join(one.objects[:5]) + ", ..." * (len(one.objects) > 5) for one in found]
    rows = [(one.name, count(len(one.objects)), text) for one, text in zip(found, shown, strict=True)]
    empty = "no set yet; `graspd objects add FOLDER` makes one"
    reports.print_rows("sets", found, ("set", "objects", ""), rows, empty=empty, json=json)


app.add_typer(hands_app, name="hands")
app.add_typer(objects_app, name="objects")
app.add_typer(networks_app, name="networks")
app.add_typer(access_commands.keys_app, name="keys")
app.add_typer(access_commands.projects_app, name="projects")
app.add_typer(access_commands.webhooks_app, name="webhooks")
app.add_typer(tag_commands.app, name="tags")


def _asset_name(client: Client, kind: AssetKind, value: str) -> str:
    """Return the name of a hand, object or network; an existing path is uploaded and checked first."""
    path = Path(value)
    if "/" not in value and path.suffix.lower() not in (*MAIN_SUFFIXES[kind], ".zip"):
        return value
    if not path.is_file():
        raise InputError(f"there is no file {value}; give a path that exists, or the name of a known {kind.value}")
    asset = upload_file(client, kind, path, None, {})
    if not asset.builtin and (asset := client.wait_for_check(kind, asset.digest)).verdict == "refuse":
        raise InputError(f"refused: {asset.message}")
    return asset.name


def _change_job(client: Client, job_id: str, verb: str) -> JobDetail:
    return client.request(JobDetail, "POST", request_path("jobs", _full_id(client, job_id), verb))


def _full_id(client: Client, prefix: str) -> str:
    if len(prefix) >= 32:
        return prefix
    return _unique_id([job.id for job in client.jobs(prefix=prefix, limit=2).items], prefix)


def _unique_id(ids: Iterable[str], prefix: str) -> str:
    found = {id for id in ids if id.startswith(prefix)}
    if len(found) > 1:
        raise InputError(f"several job ids begin with {prefix!r}; give more characters")
    return found.pop() if found else prefix
