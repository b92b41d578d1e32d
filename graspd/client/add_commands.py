"""`graspd hands add`, `objects add`, `networks add`: upload an asset or a set, and wait for its check."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Final

import typer

from graspd.api.uploads import name_of_upload
from graspd.client.client import Client
from graspd.client.reports import show_asset
from graspd.service.cli import JsonFlag, print_json
from graspd.service.command_options import with_options
from graspd.service.index.views import AssetView
from graspd.service.model.errors import InputError
from graspd.service.model.states import AssetKind
from graspd.service.store.asset_options import (
    HandCommandOptions,
    LicenceOption,
    ObjectSizeOptions,
    SourceOption,
    hand_options,
    parse_sizes,
    provenance,
)
from graspd.service.store.asset_summary import verdict_line
from graspd.service.store.assets import pack
from graspd.service.store.body_files import SUFFIXES as BODIES
from graspd.service.store.descriptions import parse_json_object
from graspd.service.store.hand_files import SUFFIXES, find_hand_files, hand_name
from graspd.service.store.object_sets import SUFFIXES as MESHES
from graspd.service.store.object_sets import Objects, find_set_objects

NameOption = Annotated[str | None, typer.Option("--name", help="Name of the asset; default: the file's name.")]
SharedOption = Annotated[bool, typer.Option("--shared", help="Share it with all projects, not only the key's project.")]
WaitOption = Annotated[bool, typer.Option("--wait/--no-wait", help="Wait for the check by a worker.")]
_CHECK_S: Final = 120.0
_SELF_TEST_S: Final = 900.0


@with_options(HandCommandOptions, "asset")
def add_hand(
    client: Client,
    file: Annotated[Path, typer.Argument(help="URDF, xacro or MJCF file with its meshes, its folder, or a ZIP of it.")],
    name: NameOption = None,
    *,
    options: dict[str, Any],
    licence: LicenceOption = None,
    source: SourceOption = None,
    self_test: Annotated[bool, typer.Option(help="Run the self-test: hold and lift simple shapes.")] = True,
    shared: SharedOption = False,
    wait: WaitOption = True,
    json: JsonFlag = False,
) -> None:
    """Upload a hand, wait for its check, and report guesses and the self-test on simple shapes."""
    options = hand_options(**options) | provenance(licence, source)
    _add(client, AssetKind.HAND, file, name, options, self_test=self_test, shared=shared, wait=wait, json=json)


@with_options(ObjectSizeOptions, "asset")
def add_object(
    client: Client,
    file: Annotated[Path, typer.Argument(help="Mesh, URDF, SDF, MJCF, ZIP of one, or folder or ZIP of many objects.")],
    name: NameOption = None,
    *,
    options: dict[str, Any],
    licence: LicenceOption = None,
    source: SourceOption = None,
    split: Annotated[bool, typer.Option("--split", help="Also make the sets NAME-train and NAME-report.")] = False,
    shared: SharedOption = False,
    wait: WaitOption = True,
    json: JsonFlag = False,
) -> None:
    """Upload an object or a set of objects, wait for the check, and report repairs."""
    if split and not wait:
        raise InputError("--split needs the checks of the objects; omit --no-wait")
    sizes = parse_sizes(options.pop("scale_to", None))
    options |= provenance(licence, source) | ({"scale_to": sizes[0]} if len(sizes) == 1 else {})
    if len(sizes) > 1:
        swept = scale_objects(find_set_objects(file) or single_object(file, name), sizes)
        add = partial(add_set, client, swept, name=name or name_of_set(file), prefix=None, split=split)
    elif files := find_set_objects(file):
        add = partial(add_set, client, files, name=name or name_of_set(file), prefix=name, split=split)
    else:
        add = partial(_add, client, AssetKind.OBJECT, file, name)
    add(options=options, shared=shared, wait=wait, json=json)


def add_network(
    client: Client,
    file: Annotated[Path, typer.Argument(help="NPZ file of the schema graspd/proposals@1.")],
    name: NameOption = None,
    licence: LicenceOption = None,
    source: SourceOption = None,
    shared: SharedOption = False,
    json: JsonFlag = False,
) -> None:
    """Upload a network that proposes grasps of a hand, as starts of jobs with `--method learned`."""
    _add(client, AssetKind.NETWORK, file, name, provenance(licence, source), shared=shared, wait=False, json=json)


def _add(
    client: Client,
    kind: AssetKind,
    file: Path,
    name: str | None,
    options: dict[str, Any],
    *,
    self_test: bool = False,
    wait: bool,
    json: bool,
    shared: bool,
) -> None:
    asset = upload_file(client, kind, file, name, options, self_test=self_test, shared=shared)
    if wait:
        asset = client.wait_for_check(kind, asset.digest, timeout_s=_SELF_TEST_S if self_test else _CHECK_S)
    show_asset(asset.model_dump(mode="json"), json=json)
    if asset.verdict == "refuse":
        raise InputError(f"refused: {asset.message}")


def upload_file(
    client: Client, kind: AssetKind, path: Path, name: str | None, options: dict[str, Any], **extra: bool
) -> AssetView:
    """Upload a file with the files that it needs; the default of `name` is the file's name."""
    with upload_of(path) as (upload, main):
        said = ({"file": main} if main else {}) | options
        return client.upload(kind, upload, name=name or name_of_upload(upload.name), options=said, **extra)


@contextmanager
def upload_of(path: Path) -> Iterator[tuple[Path, str]]:
    """Yield `path` or a temporary ZIP of all files of the hand or body, and the main file in this ZIP."""
    alone = not path.is_dir() and (path.suffix.lower() not in (*SUFFIXES, *BODIES) or not path.is_file())
    files, main = ({}, "") if alone else find_hand_files(path)
    if len(files) <= 1 and not path.is_dir():
        yield path, ""
        return
    with TemporaryDirectory(prefix="graspd-hand-") as folder:
        # Without --name, the hand gets the name of this file.
        archive = Path(folder) / f"{hand_name(path.resolve().name)}.zip"
        archive.write_bytes(pack({name: file.read_bytes() for name, file in files.items()}))
        yield archive, main


def single_object(path: Path, name: str | None) -> Objects:
    """Return a mesh file as a set of one object; InputError for anything else."""
    if path.suffix.lower() not in MESHES or not path.is_file():
        raise InputError(f"several sizes need a mesh file or a folder of meshes, not {path}")
    return {name or name_of_upload(path.name): {path.name: path.read_bytes()}}


def scale_objects(objects: Objects, sizes: Sequence[float]) -> Objects:
    """Return each object in each size [m]: `mug` at 0.08 becomes `mug-80mm`."""
    made: Objects = {}
    for name, files in objects.items():
        mesh = next(file for file in files if file != "asset.json")
        described = {"file": mesh, **parse_json_object(files.get("asset.json", b"{}"), "asset.json")}
        for size in sizes:
            text = json.dumps(described | {"scale_to": size})
            made[f"{name}-{1000 * size:g}mm"] = files | {"asset.json": text.encode()}
    return made


def name_of_set(path: Path) -> str:
    place = path.resolve()
    return name_of_upload(f"{place.name}.zip" if place.is_dir() else place.name)


def add_set(client: Client, objects: Objects, *, name: str, json: bool, **given: Any) -> None:
    """Upload objects as `upload_set` does and report the set; raise InputError if objects were refused."""
    told = upload_set(client, objects, name, **given, say=None if json else typer.echo)
    refused = [one["name"] for one in told if one["verdict"] == "refuse"]
    taken = len(told) - len(refused)
    if json:
        print_json({"objects": told, "refused": refused, "set": name if taken else None})
    elif taken:
        typer.echo(f"set {name}: {taken} objects; `graspd datasets create NAME --hands HANDS --objects {name}`")
    if refused:
        raise InputError(f"{len(refused)} of {len(told)} objects were refused: {', '.join(refused[:5])}")


def upload_set(
    client: Client,
    objects: Objects,
    set_name: str,
    *,
    prefix: str | None = None,
    options: dict[str, Any] | None = None,
    split: bool = False,
    shared: bool = False,
    wait: bool = True,
    say: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Upload objects, wait for their checks, and make a set of accepted ones; `split`: also its sides.

    Return name, verdict, message and repairs of each object; `say` is called with a line after each check.
    """
    told = [
        _upload(client, f"{prefix}-{name}" if prefix else name, files, options or {}, shared=shared)
        for name, files in objects.items()
    ]
    patience_s = _CHECK_S
    for one in told:
        if wait and one["verdict"] is None:
            one.update(_findings(client.wait_for_check(AssetKind.OBJECT, one["digest"], timeout_s=patience_s)))
            # A worker is running, but may have longer tasks.
            patience_s = _SELF_TEST_S
        if say is not None:
            say(verdict_line(one))
    if taken := [one["name"] for one in told if one["verdict"] != "refuse"]:
        client.add_object_set(set_name, taken)
    for side in ("train", "report") if split else ():
        if of_side := [one["name"] for one in told if one.get("split") == side and one["verdict"] != "refuse"]:
            client.add_object_set(f"{set_name}-{side}", of_side)
    return told


def _upload(
    client: Client, name: str, files: dict[str, bytes], options: dict[str, Any], *, shared: bool
) -> dict[str, Any]:
    try:
        with TemporaryDirectory(prefix="graspd-set-") as folder:
            archive = Path(folder) / "object.zip"
            archive.write_bytes(pack(files))
            asset = client.upload(AssetKind.OBJECT, archive, name=name, options=options, shared=shared)
    except InputError as error:
        return {"name": name, "verdict": "refuse", "message": str(error), "repairs": []}
    return {"name": asset.name, "digest": asset.digest, **_findings(asset)}


def _findings(asset: AssetView) -> dict[str, Any]:
    side = asset.facts.get("shape", {}).get("split")
    return {"verdict": asset.verdict, "message": asset.message or "", "repairs": asset.repairs, "split": side}
