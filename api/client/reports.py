"""What the commands share: the client of the settings, progress, and how jobs and assets are told."""

from __future__ import annotations

import sys
from typing import Annotated, Any

import typer

from api.client.client import Client, path_of
from api.client.watching import JobDisplay
from api.formatting import count, duration, metric, percent, worker_time
from api.models import Diversity, JobDetail
from service.cli import emit, load_settings, plain_console, plain_table
from service.model.errors import InputError, TaskError
from service.model.states import AssetKind, State
from service.run.address import recorded_address
from service.store.asset_summary import summary

UrlOption = Annotated[
    str | None,
    typer.Option("--url", help="Where the API answers; default GRASPD_API_URL, or the service of the data folder."),
]


def open_client(url: str | None, *, key: str | None = None) -> Client:
    """A client of the API that the option or the settings name, or else that serves the data folder; with their key,
    unless one is given."""
    settings = load_settings()
    if key is None and settings.api_key:
        key = settings.api_key.get_secret_value()
    if url is None and "api_url" not in settings.model_fields_set:
        url = recorded_address(settings.data_dir)
    return Client(url or settings.api_url, key=key)


YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Delete it without asking.")]


def confirm(question: str, what: str, *, yes: bool) -> None:
    """Ask before something is destroyed; InputError where the answer is no, or nobody is there to answer."""
    if yes:
        return
    if not sys.stdin.isatty():
        raise InputError(f"{what} is not deleted: there is no terminal to ask at; --yes deletes it without asking")
    if not typer.confirm(question):
        raise InputError("nothing was deleted")


def say_deleted(what: str, name: str, *, json: bool, undo: str = "") -> None:
    """Tell that a thing is gone, and the command that brings it back."""
    if json:
        emit({"deleted": name, "kind": what})
        return
    typer.echo(f"{what} {name} is deleted")
    if undo:
        typer.echo(f"`{undo}` brings it back for a while (GRASPD_SHARD_GRACE_S)", err=True)


def restore(url: str | None, what: str, name: str, *, json: bool) -> None:
    """Bring back what was deleted, and say so."""
    with open_client(url) as client:
        found = client.send("POST", path_of(f"{what}s", name, "restore")).json()
    if json:
        emit({"restored": found["id"], "kind": what})
    else:
        typer.echo(f"{what} {name} is restored")


def watch(client: Client, job_id: str) -> JobDetail:
    """The job in its final state, with progress on standard error meanwhile."""
    with JobDisplay(plain_console(stderr=True)) as display:
        return client.wait(job_id, display.update)


def show_job(job: JobDetail, *, json: bool, url: str, must_succeed: bool = True) -> None:
    """Say what became of a job; TaskError if it failed or was cancelled and should not have been."""
    if json:
        emit(job_summary(job))
    else:
        _print_job(job, url)
    if must_succeed and job.state in (State.FAILED, State.CANCELLED):
        why = f": {job.reason}" if job.reason else ""
        raise TaskError(f"job {job.id[:12]} is {job.state}{why}; `graspd retry {job.id[:12]}` runs it again")


def job_summary(job: JobDetail) -> dict[str, Any]:
    """The keys that scripts rely on (DESIGN.md §5): job, state, grasps, valid, stages, mean, shards; and more."""
    return {
        "job": job.id,
        "state": job.state.value,
        "hand": job.hand,
        "object": job.object,
        "fidelity": job.fidelity,
        "choice": job.choice and job.choice.model_dump(),
        "grasps": job.grasps,
        "valid": job.valid,
        "tried": job.tried,
        "judged": job.judged,
        "valid_yield": job.valid_yield,
        "audited": job.audited,
        "audit_held": job.audit_held,
        "note": job.note,
        "progress": job.progress,
        "reason": job.reason,
        "outcomes": job.outcomes,
        "stages": {stage.stage.value: {"tasks": stage.tasks, "seconds": stage.seconds} for stage in job.stages},
        "mean": {
            name: value
            for name, value in job.mean.model_dump().items()
            if name in ("epsilon", "contact_area_cm2", "intersection_volume_cm3")
        },
        "shards": [shard.id for shard in job.shards],
    }


def show_asset(asset: dict[str, Any], *, json: bool) -> None:
    """Say what is known of a hand or object."""
    if json:
        emit(asset)
        return
    console = plain_console()
    # A built-in one came with the service: its time is that of the release.
    times = () if asset.get("builtin") else ("created",)
    for name in ("name", "kind", "filename", "size_bytes", "digest", *times, "verdict", "message"):
        if asset.get(name) is not None:
            console.print(f"{name:<18} {asset[name]}", soft_wrap=True)
    for line in asset.get("repairs", []):
        console.print(f"{'repair':<18} {line}", soft_wrap=True)
    facts = asset.get("facts", {})
    for line in summary(AssetKind(asset["kind"]), facts) or [f"{name:<18} {value}" for name, value in facts.items()]:
        console.print(line, soft_wrap=True)


def yield_of(job: JobDetail) -> str:
    """What was found among how many tries, and what the audit says, in a line."""
    level = job.request.referee
    if level == "none":
        return f"{count(job.grasps)} grasps kept in {count(job.tried)} tries; nobody judged them"
    audit = f"; {job.audit_held} of {job.audited} audited hold by the letter" if job.audited else ""
    return f"{count(job.valid)} valid grasps in {count(job.tried)} tries, {level} level{audit}"


def means_of(job: JobDetail) -> str:
    """Means over the valid grasps, in a line."""
    mean = job.mean
    return (
        f"mean ε {metric(mean.epsilon)}, contact {metric(mean.contact_area_cm2)} cm², "
        f"intersection {metric(mean.intersection_volume_cm3)} cm³"
    )


def diversity_of(found: Diversity) -> str:
    """Types and directions, in a line."""
    types = ", ".join(f"{count(number)} {name}" for name, number in found.types.items())
    return (
        f"{types} ({found.type_entropy_bits:.2f} bit); {found.directions_used} of {found.directions} directions "
        f"({found.direction_entropy_bits:.2f} bit)"
    )


def _print_job(job: JobDetail, url: str) -> None:
    console = plain_console()
    console.print(f"{job.hand} × {job.object}  {job.state.value}  {url}/jobs/{job.id}", soft_wrap=True)
    if job.choice:
        console.print(f"fidelity: {job.fidelity}, {job.choice}", soft_wrap=True)
    if job.reason:
        console.print(f"reason: {job.reason}", soft_wrap=True)
    if job.note and job.note != job.reason:
        console.print(f"note: {job.note}")
    table = plain_table("stage", "state", "tasks", "progress", "worker time", "left")
    for stage in job.stages:
        done = f"{stage.succeeded} of {stage.tasks}"
        table.add_row(
            stage.stage, stage.state, done, percent(stage.progress), worker_time(stage), duration(stage.eta_s)
        )
    console.print(table)
    if job.grasps:
        console.print(f"{yield_of(job)}; {means_of(job)}")
        if job.diversity:
            console.print(diversity_of(job.diversity))
