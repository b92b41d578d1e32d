"""Command line: `graspd objects check` and `objects fetch`."""

from __future__ import annotations

import json as json_codec
import random
import re
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from graspd.service import user_cache
from graspd.service.cli import CommandGroup, JsonFlag, print_json, progress_bar
from graspd.service.command_options import with_options
from graspd.service.model.cores import available_cores
from graspd.service.model.errors import GraspdError, InputError
from graspd.service.model.object_options import ObjectOptions
from graspd.service.model.states import AssetKind
from graspd.service.store.asset_summary import print_check, verdict_line
from graspd.service.store.assets import builtin_names
from graspd.service.store.body_files import find_body
from graspd.service.store.object_sets import Objects, find_set_objects
from graspd.service.store.published_sets import MOST_KG, PublishedSet, fetch_objects, find_set
from graspd.worker.objects.check import check_object
from graspd.worker.objects.prepare import files_from_path, object_from_path, revision

app = CommandGroup(add_completion=False)


@app.command("check", epilog="graspd objects check banana.stl --units mm --picture banana.png")
@with_options(ObjectOptions, "asset")
def check(
    file: Annotated[str, typer.Argument(help="Mesh, URDF, SDF, MJCF, folder, ZIP, or built-in object.")],
    options: dict[str, Any],
    picture: Annotated[Path | None, typer.Option(help="PNG of the prepared mesh.")] = None,
    json: JsonFlag = False,
) -> None:
    """Check whether a mesh can be used; report its repairs and its size. Needs no server."""
    if several := _object_set(file):
        if picture:
            raise InputError(f"--picture draws one object; {file} holds {len(several)}")
        reports = []
        for name, files in several.items():
            reports.append({"name": name, **check_object(files, name, **options)})
            if not json:
                typer.echo(verdict_line(reports[-1]))
        refused = [str(one["name"]) for one in reports if one["verdict"] == "refuse"]
        if json:
            print_json({"objects": reports, "refused": refused})
        if refused:
            raise InputError(f"{len(refused)} of {len(reports)} objects were refused: {', '.join(refused[:5])}")
        return
    report = report_object(file, options)
    if picture and report["verdict"] != "refuse":
        from graspd.worker.rendering.portraits import object_portrait, write_png

        write_png(object_portrait(object_from_path(file, options=options)), picture)
    if json:
        print_json(report)
    else:
        print_check(AssetKind.OBJECT, report)
    if report["verdict"] == "refuse":
        raise typer.Exit(InputError.exit_code)


def _object_set(file: str) -> Objects | None:
    """Return the objects of a folder, or of a ZIP of several; None for one object."""
    if file in builtin_names(AssetKind.OBJECT) and not Path(file).is_file():
        return None
    try:
        return find_set_objects(Path(file))
    except InputError:
        if Path(file).is_dir():
            raise
        return None


def report_object(file: str, options: dict[str, Any] | None = None) -> dict[str, Any]:
    """Run `check_object` on a path; report an unreadable file in the same form."""
    try:
        name, files, stated = files_from_path(file)
    except GraspdError as error:
        return {"verdict": "refuse", "message": str(error), "repairs": [], "facts": {}}
    given = {key: value for key, value in (options or {}).items() if value is not None}
    return check_object(files, name, **{**stated, **given})


@app.command("fetch", epilog="graspd objects fetch pybullet-random --count 100")
def fetch(
    name: Annotated[str, typer.Argument(help="Name of a published set: pybullet-random, robosuite.")],
    to: Annotated[Path | None, typer.Option(help="Folder for the objects; nothing is added to the service.")] = None,
    count: Annotated[int, typer.Option(min=0, help="Number of objects, drawn by --seed; 0: all.")] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the drawn objects.")] = 0,
    url: Annotated[str | None, typer.Option("--url", help="Address of the API.")] = None,
    json: JsonFlag = False,
) -> None:
    """Fetch a published set from the package index, check it, and add it with its train and report sets."""
    published = find_set(name)
    objects = fetch_objects(name)
    # A larger count draws the same objects and more.
    drawn = sorted(random.Random(seed).sample(sorted(objects), len(objects))[: count or None])
    folder = to or user_cache.cache_folder("sets") / f"{name}-{published.version}"
    reports = list(_prepare_set({one: objects[one] for one in drawn}, published, folder))
    if not json:
        typer.echo("\n".join(summary_lines(reports)))
    accepted = [one["name"] for one in reports if one["verdict"] != "refuse"]
    if to is None and accepted:
        from graspd.client.add_commands import upload_set
        from graspd.client.reports import open_client

        with open_client(url) as client:
            told = upload_set(client, {one: _read_folder(folder / one) for one in accepted}, name, split=True)
        if not json:
            added = sum(one["verdict"] != "refuse" for one in told)
            typer.echo(f"sets {name}, {name}-train and {name}-report: {added} objects")
    if json:
        print_json({"objects": reports, "folder": str(folder), **_summary(reports)})


#: Record of the check of a fetched object, beside its files; the last file that is written.
_RECORD = "check.json"


def _prepare_set(objects: Objects, published: PublishedSet, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the check of each object; write accepted ones with their `asset.json`. Checks are reused."""
    waiting = {name: files for name, files in objects.items() if _held_record(folder / name) is None}
    tasks = [(name, files, published, folder / name) for name, files in waiting.items()]
    workers = ProcessPoolExecutor(available_cores(), mp_context=get_context("spawn"))
    with workers as pool, progress_bar(quiet=False) as progress:
        for number, _ in enumerate(pool.map(_prepare_object, tasks, chunksize=4), start=1):
            progress(number, len(tasks), "checking")
    for name in objects:
        if (record := _held_record(folder / name)) is not None:
            yield {"name": name, **record}


def _held_record(folder: Path) -> dict[str, Any] | None:
    try:
        found = json_codec.loads((folder / _RECORD).read_bytes())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and found.get("revision") == revision() else None


def _prepare_object(task: tuple[str, dict[str, bytes], PublishedSet, Path]) -> None:
    name, files, published, folder = task
    began = time.process_time()
    report = check_object(files, name, **({"density": published.density} if published.density else {}))
    facts = report["facts"]
    shutil.rmtree(folder, ignore_errors=True)
    if report["verdict"] != "refuse":
        said: dict[str, Any] = {"licence": published.licence, "source": published.source, "file": find_body(files)}
        if published.density:
            said |= {"mass": MOST_KG} if facts["mass_kg"] > MOST_KG else {"density": published.density}
        for inner, data in {**files, "asset.json": json_codec.dumps(said).encode()}.items():
            user_cache.write_atomically(folder / inner, [data])
    kept = {key: report[key] for key in ("verdict", "message", "repairs")}
    kept |= {"notes": facts.get("notes", []), "shape": facts.get("shape"), "revision": revision()}
    kept["seconds"] = round(time.process_time() - began, 3)
    user_cache.write_atomically(folder / _RECORD, [json_codec.dumps(kept).encode()])


def _read_folder(folder: Path) -> dict[str, bytes]:
    files = (file for file in folder.rglob("*") if file.is_file() and file.name != _RECORD)
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in files}


def _summary(reports: list[dict[str, Any]]) -> dict[str, Any]:
    """Return counts of a checked set: refusals, repairs, classes by side of the split, and times [s]."""
    accepted = [one for one in reports if one["verdict"] != "refuse"]
    half, most = np.quantile([one["seconds"] for one in reports], [0.5, 0.99])
    shapes = Counter(f"{one['shape']['class']} {one['shape']['split']}" for one in accepted)
    return {
        "accepted": len(accepted),
        "refused": Counter(kind_of(one["message"].partition(": ")[2]) for one in reports if one not in accepted),
        "repairs": Counter(kind for one in accepted for kind in set(map(kind_of, one["repairs"] + one["notes"]))),
        "shapes": dict(sorted(shapes.items())),
        "check_s": {"p50": round(half, 2), "p99": round(most, 2), "largest": max(one["seconds"] for one in reports)},
    }


def kind_of(message: str) -> str:
    """Return a message with its numbers replaced, so that equal reasons count together."""
    return re.sub(r"\d[\d.e+-]*", "N", message)


def summary_lines(reports: list[dict[str, Any]]) -> list[str]:
    found = _summary(reports)
    times = ", ".join(f"{name} {value:.2f} s" for name, value in found["check_s"].items())
    return [
        f"{found['accepted']} of {len(reports)} objects accepted; CPU time of a check: {times}",
        *(f"{number:6d}  refused: {kind}" for kind, number in found["refused"].most_common()),
        *(f"{number:6d}  accepted: {kind}" for kind, number in found["repairs"].most_common()),
        *(f"{number:6d}  {shape}" for shape, number in found["shapes"].items()),
    ]
