"""Command line: `graspd datasets card`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from service.cli import JsonFlag, emit, load_settings, plain_console, reporting_errors
from service.model.errors import InputError
from service.store.store import open_store

app = typer.Typer(no_args_is_help=True, add_completion=False)


@app.command(epilog="graspd datasets card kitchen -o kitchen-v1 --licence CC-BY-4.0")
@reporting_errors
def card(
    source: Annotated[
        str, typer.Argument(metavar="NAME", help="A dataset of the store; or a folder of shards: ./kitchen-v1.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write the card into.")],
    snapshot: Annotated[str | None, typer.Option(help="Digest of a snapshot; default: the newest.")] = None,
    licence: Annotated[str, typer.Option(help="Licence of the grasps and pictures, as SPDX names it: CC-BY-4.0.")] = "",
    text: Annotated[str, typer.Option("--source", help="A sentence on where it comes from, or whom to ask.")] = "",
    assets: Annotated[
        Path | None, typer.Option(help="JSON with licence and source of hands and objects that were added without.")
    ] = None,
    data_dir: Annotated[Path | None, typer.Option("--data-dir", help="Folder of graspd; GRASPD_DATA_DIR.")] = None,
    json: JsonFlag = False,
) -> None:
    """Write a dataset's card: what it holds, how it was made, how good and biased it is; with plots and checksums."""
    from worker.cards.card import write_card
    from worker.cards.contents import contents_of_folder, contents_of_store, with_provenance

    if "/" in source or source in (".", ".."):
        if snapshot is not None:
            raise InputError(f"{source} is a folder; --snapshot goes with the name of a dataset")
        contents = contents_of_folder(Path(source))
    else:
        contents = contents_of_store(
            open_store(load_settings(data_dir=data_dir).resolved_store_url, make=False), source, snapshot
        )
    if assets is not None:
        contents = with_provenance(contents, assets)
    columns = (TextColumn("shards"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = plain_console(stderr=True)
    with Progress(*columns, console=console, disable=json or not console.is_terminal, transient=True) as bar:
        task = bar.add_task("", total=len(contents.shards))
        found = write_card(
            contents, out, licence=licence, source=text, progress=lambda done, total: bar.update(task, completed=done)
        )
    made = found["composition"]
    told = {"out": str(out), "dataset": found["name"], "snapshot": (found["snapshot"] or {}).get("digest")}
    told |= {"grasps": made["grasps"], "valid": made["valid"], "pictures": made["pictures"], "plots": found["plots"]}
    if json:
        emit(told)
    else:
        typer.echo(
            f"{out}/README.md: {made['valid']:,} valid grasps, {len(found['plots'])} plots, checksums, card.json"
        )
