"""Command line: `graspd grasps where`, `graspd datasets balance`, `diff` and `card`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from service.cli import JsonFlag, emit, load_settings, plain_console, plain_table, reporting_errors
from service.model.errors import InputError
from service.readers.where import parse
from service.store.store import open_store
from worker.files.curation import KINDS, Balance, difference
from worker.files.subsets import Subset, shards_of, write_subset

app = typer.Typer(no_args_is_help=True, add_completion=False)

group = typer.Typer(no_args_is_help=True, help="Grasps of files and datasets, chosen by their numbers.")

app.add_typer(group, name="grasps")

SourceArgument = Annotated[
    str, typer.Argument(help="A file, a folder of shards, or a dataset of the store by its name.")
]

OutOption = Annotated[Path, typer.Option("--out", "-o", help="The folder to write; it must not be there.")]


@group.callback()
def grasps() -> None:
    """Grasps of files and datasets, chosen by their numbers."""


@group.command(epilog='graspd grasps where "epsilon > 0.3 and lift and robust >= 0.75" --from kitchen -o subset')
@reporting_errors
def where(
    expression: Annotated[str, typer.Argument(help="Metrics by name, valid, sound, held, lift; and, or, not.")],
    out: OutOption,
    source: Annotated[
        str, typer.Option("--from", help="A file, a folder of shards, or a dataset of the store by its name.")
    ] = ".",
    json: JsonFlag = False,
) -> None:
    """Write the grasps for which an expression is true as base shards of their own."""
    test = parse(expression)
    shards = shards_of(source)
    said = {"where": expression, "from": source}
    found = write_subset(
        shards, lambda together: [test(shard.arrays, shard.attributes) for shard in together], out, said=said
    )
    _tell(found, out, json=json)


@app.command(epilog="graspd datasets balance kitchen --by type,direction -o even")
@reporting_errors
def balance(
    source: SourceArgument,
    out: OutOption,
    by: Annotated[str, typer.Option(help=f"Of {', '.join(KINDS)}; several with commas.")] = "type,direction",
    at_most: Annotated[
        int, typer.Option(min=0, help="Grasps of each kind, for each hand and object; 0: as the median kind has.")
    ] = 0,
    min_distance: Annotated[
        float,
        typer.Option(min=0, max=0.1, help="No two of a hand on an object are nearer [m], in all batches; 0: any."),
    ] = 0.0,
    hand: Annotated[
        str | None, typer.Option(help="The hand's file, where distances need it and it is not found.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Which of a kind are drawn.")] = 0,
    json: JsonFlag = False,
) -> None:
    """Write a part of a dataset in which no kind of valid grasps is more frequent than others."""
    kinds = [one.strip() for one in by.split(",") if one.strip()]
    chooser = Balance(kinds, at_most, min_distance, seed, hand)
    said = {"balance": kinds, "from": source, "at_most": at_most, "min_distance": min_distance, "seed": seed}
    _tell(write_subset(shards_of(source), chooser, out, said=said), out, json=json)


@app.command(epilog="graspd datasets diff kitchen-v1 kitchen-v2 --json")
@reporting_errors
def diff(
    first: SourceArgument,
    second: SourceArgument,
    json: JsonFlag = False,
) -> None:
    """What two datasets, or two versions of one, do not have in common: NAME@SNAPSHOT is a version."""
    found = difference(*(shards_of(*_version(one)) for one in (first, second)))
    if json:
        emit({"a": first, "b": second, **found})
        return
    console = plain_console()
    if not found["cells"] and not found["settings"]:
        console.print(f"the same grasps in {found['same_cells']} cells")
        return
    table = plain_table("hand", "object", "grasps", "valid", "in both")
    for one in found["cells"]:
        counts = (f"{one['first']} | {one['second']}", f"{one['valid_first']} | {one['valid_second']}")
        table.add_row(one["hand"], one["object"], *counts, str(one["common"]))
    console.print(table if found["cells"] else "the same grasps")
    for name, values in found["settings"].items():
        console.print(f"{name}: {_listed(values['first'])} | {_listed(values['second'])}")
    console.print(f"{found['same_cells']} cells have the same grasps")


def _version(source: str) -> tuple[str, str | None]:
    if "/" in source or "@" not in source or Path(source).exists():
        return source, None
    name, _, snapshot = source.partition("@")
    if not snapshot:
        raise InputError(f"{source}: write the digest of a snapshot after @")
    return name, snapshot


def _listed(values: list[str]) -> str:
    shown = ", ".join(value[:40] for value in values[:4])
    return (shown + (f" and {len(values) - 4} more" if len(values) > 4 else "")) or "-"


def _tell(found: Subset, out: Path, *, json: bool) -> None:
    told: dict[str, Any] = {"folder": str(out), "looked_at": found.looked_at, "kept": found.kept}
    told["shards"] = len(found.files)
    if json:
        emit(told | {"passed_over": found.passed_over})
        return
    typer.echo(f"{out}: {found.kept} of {found.looked_at} grasps in {len(found.files)} shards")
    if found.passed_over:
        typer.echo(f"{found.passed_over} shards of scenes and pictures are not carried over", err=True)


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
