"""Terminal output of the commands: progress, jobs, assets, estimates and datasets."""

from __future__ import annotations

import functools
import inspect
import sys
import time
from collections.abc import Callable, Collection, Sequence
from typing import Annotated, Any, Final

import typer
from pydantic import BaseModel
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from graspd.api.formatting import count, duration, metric, percent, size, valid_yield, worker_time
from graspd.api.models import Job, JobDetail, StageStatus
from graspd.client.client import Client, request_path
from graspd.service.cli import CommandGroup, load_settings, plain_console, plain_table, print_json, print_result
from graspd.service.command_options import set_parameters
from graspd.service.index.views import CellView, DatasetView, Validated
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError, TaskError
from graspd.service.model.states import AssetKind, Stage, State
from graspd.service.pipeline.datasets.spec import Estimate
from graspd.service.run.address import recorded_address
from graspd.service.store.asset_summary import summary

UrlOption = Annotated[str | None, typer.Option("--url", help="URL of the API; default: GRASPD_API_URL or a local one.")]


def open_client(url: str | None, *, key: str | None = None) -> Client:
    """Return a client; the default of `url` is the setting or the recorded address, of `key` the setting."""
    settings = load_settings()
    if key is None and settings.api_key:
        key = settings.api_key.get_secret_value()
    if url is None and "api_url" not in settings.model_fields_set:
        url = recorded_address(settings.data_dir)
    return Client(url or settings.api_url, key=key)


class ClientGroup(CommandGroup):
    """Group of commands; their parameter `client` becomes the option `--url` before the last parameter."""

    def command(self, *names: Any, **options: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:  # type: ignore[override]
        add = super().command(*names, **options)
        return lambda command: add(
            _with_client(command) if "client" in inspect.signature(command).parameters else command
        )


def _with_client(command: Callable[..., None]) -> Callable[..., None]:
    @functools.wraps(command)
    def wrapper(url: str | None, **given: Any) -> None:
        with open_client(url) as client:
            command(client=client, **given)

    own = [one for one in inspect.signature(command, eval_str=True).parameters.values() if one.name != "client"]
    option = inspect.Parameter("url", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=UrlOption)
    return set_parameters(wrapper, [*own[:-1], option, own[-1]])


YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Delete without confirmation.")]


def delete(
    client: Client, what: str, name: str, question: str, *, yes: bool, json: bool, undo: str = "", **params: Any
) -> None:
    """Delete a resource after a confirmation; InputError if the answer is no, or without a terminal."""
    if not yes and not sys.stdin.isatty():
        raise InputError(
            f"{what} {name} is not deleted: there is no terminal for the confirmation; --yes deletes without it"
        )
    if not yes and not typer.confirm(question):
        raise InputError("nothing was deleted")
    client.send("DELETE", request_path(f"{what}s", name), params=params)
    print_result({"deleted": name, "kind": what}, f"{what} {name} is deleted", json=json)
    if undo and not json:
        typer.echo(f"`{undo}` restores it within the grace time (GRASPD_SHARD_GRACE_S)", err=True)


def restore(client: Client, what: str, name: str, *, json: bool) -> None:
    found = client.send("POST", request_path(f"{what}s", name, "restore")).json()
    print_result({"restored": found["id"], "kind": what}, f"{what} {name} is restored", json=json)


def print_rows(
    what: str,
    found: Sequence[BaseModel | dict[str, Any]],
    headings: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    whole: Collection[str] = (),
    empty: str = "",
    json: bool,
    **more: Any,
) -> None:
    """Print a list as JSON or as a table; `empty`: text for no rows; `whole`: columns without wrapping."""
    if json:
        items = [one.model_dump(mode="json") if isinstance(one, BaseModel) else one for one in found]
        print_json({what: items, **more})
        return
    table = plain_table(*headings, whole=whole)
    for row in rows:
        table.add_row(*row)
    plain_console().print(table if rows or not empty else empty)


def watch(client: Client, job_id: str) -> JobDetail:
    """Return the job in its final state; show its progress on standard error meanwhile."""
    with JobDisplay(plain_console(stderr=True)) as display:
        return client.wait(job_id, display.show)


def show_job(job: JobDetail, *, json: bool, url: str, must_succeed: bool = True) -> None:
    """Print a job; if `must_succeed`, raise TaskError for a failed or cancelled job."""
    if json:
        print_json(job_summary(job))
    else:
        _print_job(job, url)
    if must_succeed and job.state in (State.FAILED, State.CANCELLED):
        why = f": {job.reason}" if job.reason else ""
        raise TaskError(f"job {job.id[:12]} is {job.state}{why}; `graspd retry {job.id[:12]}` runs it again")


_SUMMARY: Final = (
    *("grasps", "valid", "candidates", "validated", "valid_yield", "rechecked", "recheck_held"),
    *("second_tested", "second_held"),
    *("note", "progress", "reason", "outcomes", "episodes"),
)


def job_summary(job: JobDetail) -> dict[str, Any]:
    """Return a job as JSON for scripts: job, state, grasps, valid, stages, mean, shards and others."""
    return {
        "job": job.id,
        "state": job.state.value,
        "hand": job.hand,
        "object": job.object,
        "fidelity": job.fidelity,
        "choice": job.choice and job.choice.model_dump(),
        **{name: getattr(job, name) for name in _SUMMARY},
        "stages": {stage.stage.value: {"tasks": stage.tasks, "seconds": stage.seconds} for stage in job.stages},
        "mean": job.mean.model_dump(include={"epsilon", "contact_area_cm2", "intersection_volume_cm3"}),
        "shards": [shard.id for shard in job.shards],
    }


def show_asset(asset: dict[str, Any], *, json: bool) -> None:
    if json:
        print_json(asset)
        return
    console = plain_console()
    # The time of a built-in asset is that of the release, so it is omitted.
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
    """Format the valid grasps per candidate, and the result of the recheck, in one line."""
    level = job.request.validation
    if level == "none":
        return f"{count(job.grasps)} stored grasps of {count(job.candidates)} candidates; not validated"
    line = f"{count(job.valid)} valid grasps of {count(job.candidates)} candidates, level {level}"
    if job.rechecked:
        line += f"; {job.recheck_held} of {job.rechecked} rechecked hold under the DexGraspBench protocol"
    if job.second_tested:
        line += f"; {job.second_held} of {job.second_tested} hold in {' and '.join(job.request.second_engines)}"
    return line


def mean_metrics(job: JobDetail) -> str:
    epsilon, area, volume = map(metric, (job.mean.epsilon, job.mean.contact_area_cm2, job.mean.intersection_volume_cm3))
    return f"mean ε {epsilon}, contact {area} cm², intersection {volume} cm³"


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
        done, times = f"{stage.succeeded} of {stage.tasks}", (worker_time(stage), duration(stage.eta_s))
        table.add_row(stage.stage, stage.state, done, percent(stage.progress), *times)
    console.print(table)
    if job.grasps:
        console.print(f"{yield_of(job)}; {mean_metrics(job)}")
        if job.episodes:
            console.print(f"episodes: {', '.join(f'{count(number)} {name}' for name, number in job.episodes.items())}")
        if found := job.diversity:
            types = ", ".join(f"{count(number)} {name}" for name, number in found.types.items())
            directions = f"{found.directions_used} of {found.directions} directions"
            entropy = f"({found.type_entropy_bits:.2f} bit)", f"({found.direction_entropy_bits:.2f} bit)"
            console.print(f"{types} {entropy[0]}; {directions} {entropy[1]}")


_LINE_EVERY_S: Final = 2.0


class JobDisplay(Progress):
    """Context manager that shows a job's progress: bars on a terminal, elsewhere lines."""

    def __init__(self, console: Console) -> None:
        columns = (
            TextColumn("{task.description:<11}"),
            BarColumn(bar_width=32),
            TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("{task.fields[rate]}", style="cyan"),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            TextColumn("{task.fields[message]}", style="dim", markup=False),
        )
        super().__init__(*columns, console=console, disable=not console.is_terminal)
        self._said: dict[Stage, tuple[float, State]] = {}

    def show(self, job: Job) -> None:
        for stage in job.stages:
            bar = next((one for one in self.tasks if one.description == stage.stage.value), None)
            if bar is None:
                self.add_task(stage.stage.value, total=stage.tasks, start=False, message="", rate="")
                bar = self.tasks[-1]
            if stage.state is not State.QUEUED and not bar.started:
                self.start_task(bar.id)
            seconds = bar.elapsed or 0.0
            rate = _rate_text(stage, job, seconds)
            message = stage.message if stage.state is State.RUNNING else stage.state.value
            self.update(bar.id, completed=stage.done, message=message, rate=rate)
            if not self.console.is_terminal:
                self._print_state(stage, rate, seconds)

    def _print_state(self, stage: StageStatus, rate: str, seconds: float) -> None:
        now, (at, state) = time.monotonic(), self._said.get(stage.stage, (0.0, State.QUEUED))
        if stage.state is state and (state is not State.RUNNING or now - at < _LINE_EVERY_S):
            return
        self._said[stage.stage] = (now, stage.state)
        words = f"{stage.stage.value:<11} {stage.state.value:<10} {100 * stage.progress:3.0f} %"
        if rate and stage.state is State.SUCCEEDED:
            words += f"  {rate}  in {duration(stage.seconds or seconds)}"
        elif rate:
            words += f"  {rate}  {duration(seconds / stage.progress - seconds)} left"
        self.console.print(words)


def _rate_text(stage: StageStatus, job: Job, seconds: float) -> str:
    """Return the pace of a stage after its end, or `seconds` after its start; "" in the first second."""
    share = stage.progress if stage.state is State.RUNNING and seconds > 1 else 0.0
    if stage.state is State.SUCCEEDED:
        share, seconds = 1.0, stage.seconds or seconds
    made, unit = (job.requested, "grasps") if stage.stage is Stage.SYNTHESIZE else (stage.tasks, "tasks")
    return f"{metric(made * share / seconds)} {unit}/s" if share and seconds else ""


#: Maximum number of hands in a table; with more hands, each cell has a line.
_MOST_COLUMNS: Final = 6
_SHOWN_RATES: Final = 8
_STYLES: Final = {"succeeded": "green", "running": "cyan", "queued": "dim", "failed": "red", "cancelled": "yellow"}


def print_estimate(found: Estimate, console: Console) -> None:
    """Print time for several numbers of workers, storage, network, and the source of the rates."""
    console.print(
        f"{count(found.cells)} cells, {count(found.asked)} grasps: about {count(found.candidates)} candidates, "
        f"{count(found.valid)} {found.counted}, {count(found.tasks)} tasks",
        soft_wrap=True,
    )
    table = plain_table("workers", "time", "from", "to", "network", "on average")
    for plan in found.plans:
        rate = f"{size(round(plan.network_bytes_per_s))}/s"
        times = (plan.seconds, plan.seconds_low, plan.seconds_high)
        table.add_row(str(plan.workers), *map(duration, times), size(plan.network_bytes), rate)
    console.print(table)
    kinds = ", ".join(f"{kind} {size(stored)}" for kind, stored in found.storage_by_kind.items())
    console.print(f"storage {size(found.storage_bytes)} ({kinds})")
    width = max(len(used.hand) for used in found.rates[:_SHOWN_RATES])
    for used in found.rates[:_SHOWN_RATES]:
        seconds = None if used.seconds_per_valid is None else metric(used.seconds_per_valid)
        each = f"no {found.counted} grasp" if seconds is None else f"{seconds} s per {found.counted} grasp"
        batches = f", {count(used.batches)} batches" if used.batches else ""
        console.print(
            f"  {used.hand:<{width}} {each}, yield {percent(used.valid_yield)} "
            f"({used.origin}{batches}) for {count(used.cells)} cells",
            soft_wrap=True,
        )
    if len(found.rates) > _SHOWN_RATES:
        console.print(f"  and {len(found.rates) - _SHOWN_RATES} more rates; --json shows them", style="dim")


def print_dataset(dataset: DatasetView, console: Console) -> None:
    states = ", ".join(f"{count(n)} {state.value}" for state, n in dataset.states.items() if n)
    left = f", {duration(dataset.eta_s)} left" if dataset.eta_s is not None else ""
    console.print(f"{dataset.name}  {dataset.state.value}  {percent(dataset.progress)}{left}")
    console.print(f"cells: {states}")
    candidates = f" of {count(dataset.candidates)} candidates ({_yield_text(dataset)})" if dataset.candidates else ""
    console.print(
        f"grasps: {count(dataset.counted_grasps)} {dataset.options.displayed_status}{candidates}, "
        f"{count(dataset.asked)} requested; "
        f"{count(dataset.shards)} shards, {size(dataset.size_bytes)}; worker time {duration(dataset.seconds)}",
        soft_wrap=True,
    )
    if dataset.reason:
        console.print(f"reason: {dataset.reason}", soft_wrap=True)


def print_cells(dataset: DatasetView, cells: Sequence[CellView], console: Console) -> None:
    """Print objects as rows and hands as columns, each cell with its state, yield and failures."""
    if len(dataset.hands) > _MOST_COLUMNS:
        table = plain_table("hand", "object", "job", "", whole=("job",))
        for cell in cells:
            words = _cell_text(cell, dataset.options)
            table.add_row(cell.hand, cell.object, cell.job_id[:12], words, style=_STYLES[cell.state])
    else:
        table = plain_table("", *dataset.hands)
        at = {(cell.hand, cell.object): cell for cell in cells}
        for obj in dataset.objects:
            row = [at.get((hand, obj)) for hand in dataset.hands]
            texts = [Text(_cell_text(cell, dataset.options), _STYLES[cell.state]) if cell else "" for cell in row]
            table.add_row(obj, *texts)
    console.print(table)
    for cell in [cell for cell in cells if cell.reason][:5]:
        console.print(f"{cell.hand} on {cell.object}: {cell.reason}", soft_wrap=True)


def watch_dataset(client: Client, name: str, console: Console) -> DatasetView:
    """Return the dataset in its final state; show a bar of its tasks meanwhile."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=32),
        TextColumn("{task.percentage:>3.0f} %"),
        TextColumn("{task.fields[rate]}", style="cyan"),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task(name, total=1.0, rate="", left="")
        said = -1.0
        for dataset in client.watch_dataset(name):
            pace = metric(dataset.counted_grasps / dataset.seconds) if dataset.seconds else None
            rate = f"{pace} {dataset.options.displayed_status}/s per worker" if pace is not None else ""
            left = f"{duration(dataset.eta_s)} left" if dataset.eta_s is not None else ""
            progress.update(bar, completed=dataset.progress, rate=rate, left=left)
            if not console.is_terminal and dataset.progress - said >= 0.05:
                said = dataset.progress
                console.print(f"{name} {percent(dataset.progress)} {rate} {left}")
    return dataset


def _yield_text(made: Validated) -> str:
    return f"at {valid_yield(made)}" if made.validated else "not validated"


def _cell_text(cell: CellView, options: JobOptions) -> str:
    words = [cell.state.value]
    if cell.state is State.RUNNING:
        words.append(percent(cell.progress))
    if cell.candidates:
        made = cell.counted_grasps(options)
        words.append(f"{count(made)}/{count(cell.asked)} {_yield_text(cell)}")
    if cell.tasks_failed:
        words.append(f"{cell.tasks_failed} failed")
    return " ".join(words)
