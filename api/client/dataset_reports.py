"""How estimates and datasets are told on a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

from api.client.client import Client
from api.formatting import count, duration, metric, percent, size, valid_yield
from service.cli import plain_table
from service.index.views import CellView, DatasetView, Judged
from service.model.domain import JobOptions
from service.model.states import State
from service.pipeline.datasets.estimate import Estimate

#: A table with more hands does not fit a terminal: then each cell has a line.
_MOST_COLUMNS: Final = 6
_SHOWN_RATES: Final = 8
_STYLES: Final = {
    State.SUCCEEDED: "green",
    State.RUNNING: "cyan",
    State.QUEUED: "dim",
    State.FAILED: "red",
    State.CANCELLED: "yellow",
}


def print_estimate(found: Estimate, console: Console) -> None:
    """Time for some numbers of workers, storage, network, and what the rates are known from."""
    console.print(
        f"{count(found.cells)} cells, {count(found.asked)} grasps asked for: about {count(found.tried)} tries, "
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
        each = f"no {found.counted} grasp" if used.seconds_per_valid is None else f"{metric(used.seconds_per_valid)} s"
        batches = f", {count(used.batches)} batches" if used.batches else ""
        console.print(
            f"  {used.hand:<{width}} {each} per {found.counted} grasp, yield {percent(used.valid_yield)} "
            f"({used.origin}{batches}) for {count(used.cells)} cells",
            soft_wrap=True,
        )
    if len(found.rates) > _SHOWN_RATES:
        console.print(f"  and {len(found.rates) - _SHOWN_RATES} more rates; --json shows them", style="dim")


def print_dataset(dataset: DatasetView, console: Console) -> None:
    """A dataset in three lines."""
    states = ", ".join(f"{count(n)} {state.value}" for state, n in dataset.states.items() if n)
    left = f", {duration(dataset.eta_s)} left" if dataset.eta_s is not None else ""
    console.print(f"{dataset.name}  {dataset.state.value}  {percent(dataset.progress)}{left}")
    console.print(f"cells: {states}")
    tried = f" of {count(dataset.tried)} tried ({_yield(dataset)})" if dataset.tried else ""
    console.print(
        f"grasps: {count(dataset.counted)} {dataset.options.standing}{tried}, {count(dataset.asked)} asked for; "
        f"{count(dataset.shards)} shards, {size(dataset.size_bytes)}; worker time {duration(dataset.seconds)}",
        soft_wrap=True,
    )
    if dataset.reason:
        console.print(f"reason: {dataset.reason}", soft_wrap=True)


def print_cells(dataset: DatasetView, cells: Sequence[CellView], console: Console) -> None:
    """Objects as rows and hands as columns, each cell with its state, yield and failures."""
    if len(dataset.hands) > _MOST_COLUMNS:
        table = plain_table("hand", "object", "job", "", whole=("job",))
        for cell in cells:
            table.add_row(
                cell.hand, cell.object, cell.job_id[:12], _words(cell, dataset.options), style=_STYLES[cell.state]
            )
    else:
        table = plain_table("", *dataset.hands)
        at = {(cell.hand, cell.object): cell for cell in cells}
        for obj in dataset.objects:
            found = [at.get((hand, obj)) for hand in dataset.hands]
            table.add_row(obj, *(_styled(cell, dataset.options) if cell else "" for cell in found))
    console.print(table)
    for cell in [cell for cell in cells if cell.reason][:5]:
        console.print(f"{cell.hand} on {cell.object}: {cell.reason}", soft_wrap=True)


def watch_dataset(client: Client, name: str, console: Console) -> DatasetView:
    """The dataset in its final state, with a bar of its tasks meanwhile."""
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
            pace = metric(dataset.counted / dataset.seconds) if dataset.seconds else None
            rate = f"{pace} {dataset.options.standing}/s per worker" if pace is not None else ""
            left = f"{duration(dataset.eta_s)} left" if dataset.eta_s is not None else ""
            progress.update(bar, completed=dataset.progress, rate=rate, left=left)
            if not console.is_terminal and dataset.progress - said >= 0.05:
                said = dataset.progress
                console.print(f"{name} {percent(dataset.progress)} {rate} {left}")
    return dataset


def _yield(made: Judged) -> str:
    """`at 94 % of the judged`, in short."""
    return f"at {valid_yield(made)}" if made.judged else "not judged"


def _styled(cell: CellView, options: JobOptions) -> Text:
    return Text(_words(cell, options), style=_STYLES[cell.state])


def _words(cell: CellView, options: JobOptions) -> str:
    words = [cell.state.value]
    if cell.state is State.RUNNING:
        words.append(percent(cell.progress))
    if cell.tried:
        made = cell.counted(options)
        words.append(f"{count(made)}/{count(cell.asked)} {_yield(cell)}")
    if cell.tasks_failed:
        words.append(f"{cell.tasks_failed} failed")
    return " ".join(words)
