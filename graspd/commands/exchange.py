"""Commands `graspd export`, `graspd import`, `graspd datasets card` and `graspd datasets publish`."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
import typer

from graspd.exchange.opening import check_written_files
from graspd.exchange.plan import ExportOptions, ExportSummary
from graspd.service.cli import CommandGroup, DataDir, JsonFlag, load_settings, print_result, progress_bar
from graspd.service.command_options import with_fields
from graspd.service.model.errors import InputError, choices_text
from graspd.service.store import validity
from graspd.service.store.shards import read_shard
from graspd.service.store.store import open_store
from graspd.service.store.usd_layers import import_usd
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.subsets import EveryOption, open_source

if TYPE_CHECKING:
    from graspd.studies.cards.contents import Contents

app = CommandGroup(no_args_is_help=True)

#: Formats of robots and their simulators; `moveit` and `urdf+yaml` are the same format.
ROBOTS: Final = ("moveit", "urdf+yaml", "mujoco", "usd", "glb", "isaac", "csv")
TRAINING: Final = ("dexlearn", "graspgen", "huggingface", "lerobot")
EXPORTS: Final = ("images", "replicator", "webdataset", "dexgraspbench", *TRAINING, *ROBOTS)
IMPORTS: Final = ("dexgraspbench", "dexlearn", "graspgen", "dexgraspnet", "reference")


@app.command(epilog="graspd export grasps.h5 --format dexgraspbench -o bench")
@with_fields(ExportOptions)
def export(
    source: Annotated[
        str, typer.Argument(help="Shard; for dexgraspbench, webdataset and training a folder or dataset, too.")
    ],
    format_: Annotated[str, typer.Option("--format", help=", ".join(EXPORTS) + ".")] = "images",
    *,
    options: ExportOptions,
    split: Annotated[str, typer.Option(help="For dexgraspbench: only one split, train or test; default: all.")] = "",
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")] = Path("export"),
    json: JsonFlag = False,
) -> None:
    """Write grasps or pictures in other formats."""
    if format_ not in EXPORTS:
        raise InputError(f"there is no export format {format_!r}; choose one of {choices_text(format_, EXPORTS)}")
    if options.depth not in ("exr", "png"):
        raise InputError(f"there is no depth format {options.depth!r}; use exr or png")
    if split not in ("", "train", "test"):
        raise InputError(f"there is no split {split!r}; use train or test")
    with check_written_files(output):
        if format_ in ROBOTS:
            from graspd.exchange.robot_export import export_grasps

            done = export_grasps(Path(source), format_, options, output)
        elif format_ == "dexgraspbench":
            from graspd.exchange.training_export import export_bench

            done = export_bench(source, options, split, output)
        elif format_ in TRAINING:
            from graspd.exchange.training_export import export_training

            done = export_training(source, format_, options, output)
        elif format_ == "webdataset":
            done = _export_webdataset(source, output, options)
        else:
            done = _export_pictures(Path(source), format_, options.depth, output)
    _report({"folder": str(output), "format": format_}, output, done, json=json)


def _report(told: dict[str, Any], output: Path, done: ExportSummary, *, json: bool) -> None:
    line = f"{output}: " + ", ".join(f"{n} {what}" for what, n in done.counts.items() if isinstance(n, int))
    print_result(told | done.counts | ({"notes": done.notes} if done.notes else {}), line, json=json)
    for note in () if json else done.notes:
        typer.echo(note, err=True)


@app.command("import", epilog="graspd import grasps.npy --format dexgraspnet --hand shadow --object mug.obj")
def import_(
    source: Annotated[Path, typer.Argument(help="File or folder of grasps.")],
    format_: Annotated[str, typer.Option("--format", help=", ".join(IMPORTS) + ".")],
    licence: Annotated[str, typer.Option(help="Licence of the grasps, written into every file.")],
    origin: Annotated[str, typer.Option("--source", help="Source of the grasps: a URL or a citation.")],
    hand: Annotated[str | None, typer.Option(help="Hand: a URDF or a built-in.")] = None,
    object_: Annotated[str | None, typer.Option("--object", help="Mesh of the object at the source's scale 1.")] = None,
    name: Annotated[str, typer.Option(help="graspgen: name of the object.")] = "",
    validation: Annotated[str, typer.Option(help="Level: dexgraspbench, standard, fast or none.")] = "standard",
    friction: Annotated[float, typer.Option(help="Coulomb friction coefficient of the metrics.")] = 1.0,
    threads: Annotated[int, typer.Option(help="CPU threads; 0: one per core.")] = 0,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")] = Path("imported"),
    json: JsonFlag = False,
) -> None:
    """Read grasps from other formats, validate and measure them, and write base shards.

    No code in the files is executed. Meshes are written next to the shards, at the scale of the grasps.
    """
    from graspd.worker.engines import backend

    backend.start_warp()
    from graspd.exchange.imported import Origin
    from graspd.exchange.scoring import write_scored

    sets = read_sets(format_, source, hand, object_, name)
    said, run = Origin(format_, origin, licence), ExecutionContext(threads=threads)
    found = [
        _summary(write_scored(one, said, output, validation=validation, friction=friction, ordinal=k, run=run))
        for k, one in enumerate(sets)
    ]
    (output / "source.json").write_text(jsonlib.dumps(vars(said), indent=1) + "\n")
    lines = []
    for one in found:
        validated = "not validated" if validation == "none" else f"{one['valid']} valid at level {validation}"
        if one["published"]:
            validated += f"; {one['published']} have a published verdict"
        if one["agreement_published"] is not None:
            validated += f", {one['agreement_published']:.0%} of them equal to ours"
        lines.append(f"{one['file']}: {one['grasps']} grasps, {one['feasible']} feasible, {validated}")
    print_result({"folder": str(output), "shards": found}, "\n".join(lines), json=json)


def read_sets(format_: str, source: Path, hand: str | None, obj: str | None, name: str = "") -> list[Any]:
    """Return the sets of grasps in a file; `hand` is a URDF or built-in hand, `obj` a mesh at scale 1.
    `name` selects an object of GraspGen's files."""
    from graspd.exchange import dexgraspbench, graspgen, published

    if format_ not in IMPORTS:
        raise InputError(f"there is no import format {format_!r}; choose one of {choices_text(format_, IMPORTS)}")
    if not source.exists():
        raise InputError(f"{source} does not exist")
    if format_ == "reference":
        return published.read_reference(source, hand=hand, obj=obj)
    if hand is None or obj is None:
        raise InputError(f"{format_} files contain neither hand nor object; give --hand and --object")
    if format_ == "graspgen":
        return graspgen.read(source, hand=hand, obj=obj, object_name=name)
    read = published.read_dexgraspnet if format_ == "dexgraspnet" else dexgraspbench.read
    return read(source, hand=hand, obj=obj)


def _export_pictures(source: Path, format_: str, depth: str, output: Path) -> ExportSummary:
    from graspd.exchange import replicator
    from graspd.worker.rendering.export import export_images

    views = read_shard(source, kind="views")
    if format_ == "replicator":
        written = replicator.write(views, output)
    else:
        written = export_images(views, output, depth="exr" if depth == "exr" else "png")
    return ExportSummary({"pictures": len(views["camera/eye"]), "files": len(written)})


def _export_webdataset(source: str, output: Path, options: ExportOptions) -> ExportSummary:
    from graspd.exchange import webdataset
    from graspd.service.readers import Pictures

    shards = open_source(source)
    written = webdataset.write(shards, output, valid=not options.every, unvalidated=options.unvalidated)
    return ExportSummary({"pictures": len(Pictures(shards)), "files": len(written)})


def _summary(file: Path) -> dict[str, Any]:
    shard = read_shard(file, kind="base")
    valid, feasible = validity.valid_mask(shard.arrays), validity.feasible_mask(shard.arrays)
    said = np.asarray(shard.arrays.get("quality/published", np.full(len(valid), -1)))
    both = (said >= 0) & validity.validated_mask(shard.arrays)
    agree = float((said == shard.arrays["quality/success"])[both].mean()) if both.any() else None
    return {
        "file": str(file),
        "object": shard.attributes["object"],
        "grasps": len(valid),
        "valid": int(valid.sum()),
        "feasible": int(feasible.sum()),
        "published": int((said >= 0).sum()),
        "agreement_published": agree,
    }


@app.command(epilog="graspd simready mug.usd --grasps grasps.h5 -o mug-simready.usd")
def simready(
    source: Annotated[Path, typer.Argument(help="USD file of the object.")],
    grasps: Annotated[list[Path], typer.Option(help="Base shard of the object; repeat it for several hands.")],
    best: Annotated[int, typer.Option(min=0, help="Number of best grasps of each shard by epsilon; 0: all.")] = 10,
    output: Annotated[Path, typer.Option("--output", "-o", help="USD file to write.")] = Path("simready.usd"),
    json: JsonFlag = False,
) -> None:
    """Write the object's USD file with its valid grasps, as NVIDIA's SimReady foundation asks."""
    import_usd()
    from graspd.exchange.simready import write_simready

    done = write_simready(source, grasps, output, best=best)
    _report({"file": str(output)}, output, done, json=json)


SourceName = Annotated[str, typer.Argument(metavar="NAME", help="Dataset of the store, or folder: ./kitchen-v1.")]
SnapshotOption = Annotated[str | None, typer.Option(help="Digest of a snapshot; default: the newest.")]
LicenceOption = Annotated[str, typer.Option(help="SPDX licence of grasps and pictures, such as CC-BY-4.0.")]
OriginOption = Annotated[str, typer.Option("--source", help="Origin or contact, in one sentence.")]
AssetsOption = Annotated[Path | None, typer.Option(help="JSON file of missing licences and sources of assets.")]


@app.command(epilog="graspd datasets card kitchen -o kitchen-v1 --licence CC-BY-4.0")
def card(
    source: SourceName,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the card.")],
    snapshot: SnapshotOption = None,
    licence: LicenceOption = "",
    text: OriginOption = "",
    assets: AssetsOption = None,
    data_dir: DataDir = None,
    json: JsonFlag = False,
) -> None:
    """Write a dataset's card: contents, origin, quality and biases; with plots and checksums."""
    from graspd.studies.cards.card import write_card

    contents = _contents(source, snapshot, assets, data_dir)
    with progress_bar(quiet=json) as report:
        found = write_card(
            contents, out, licence=licence, source=text, progress=lambda done, total: report(done, total, "shards")
        )
    made = found["composition"]
    told = {"out": str(out), "dataset": found["name"], "snapshot": (found["snapshot"] or {}).get("digest")}
    told |= {"grasps": made["grasps"], "valid": made["valid"], "pictures": made["pictures"], "plots": found["plots"]}
    line = f"{out}/README.md: {made['valid']:,} valid grasps, {len(found['plots'])} plots, checksums, card.json"
    print_result(told, line, json=json)


@app.command(epilog="graspd datasets publish kitchen --to hf://my-lab/kitchen --licence CC-BY-4.0")
def publish(
    source: SourceName,
    to: Annotated[str, typer.Option(help="Folder, or hf://ORGANISATION/NAME: folder NAME, then uploaded.")],
    snapshot: SnapshotOption = None,
    licence: LicenceOption = "",
    text: OriginOption = "",
    assets: AssetsOption = None,
    accept: Annotated[
        bool, typer.Option("--accept-unknown-licences", help="Publish without some licences; the card names them.")
    ] = False,
    every: EveryOption = False,
    held_out: Annotated[float, typer.Option(min=0, max=0.9, help="Share of objects in split test; 0: no split.")] = 0.2,
    tars: Annotated[
        bool, typer.Option("--webdataset/--no-webdataset", help="Write the pictures as tar files, too.")
    ] = True,
    public: Annotated[bool, typer.Option("--public", help="Make a new repository public; default: private.")] = False,
    data_dir: DataDir = None,
    json: JsonFlag = False,
) -> None:
    """Write a dataset for a hub: Parquet, WebDataset, card, Croissant, licences, checksums; upload it.

    The folder appears when it is complete. The same command continues an interrupted one.
    """
    from graspd.studies.publication import Hub, PublicationOptions
    from graspd.studies.publication import publish as write_publication

    hub = Hub(to.removeprefix("hf://")) if to.startswith("hf://") else None
    folder = Path(hub.repository.split("/")[1] if hub else to)
    contents = _contents(source, snapshot, assets, data_dir)
    options = PublicationOptions(licence, text, every, held_out, tars, accept)
    with progress_bar(quiet=json) as report:
        write_publication(contents, folder, options, report, name=hub.repository if hub else "")
    address = hub.upload(folder, public=public) if hub else ""
    files = sorted(str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file())
    told = {"folder": str(folder), "dataset": contents.name, "files": files, "uploaded": address}
    print_result(told, f"{folder}: {len(files)} files" + (f", uploaded: {address}" if address else ""), json=json)


def _contents(source: str, snapshot: str | None, assets: Path | None, data_dir: Path | None) -> Contents:
    from graspd.studies.cards.contents import add_provenance, contents_of_folder, contents_of_store

    if "/" in source or source in (".", ".."):
        if snapshot is not None:
            raise InputError(f"{source} is a folder; --snapshot goes with the name of a dataset")
        contents = contents_of_folder(Path(source))
    else:
        store = open_store(load_settings(data_dir=data_dir).resolved_store_url, make=False)
        contents = contents_of_store(store, source, snapshot)
    return contents if assets is None else add_provenance(contents, assets)
