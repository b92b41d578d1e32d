"""`graspd objects add FOLDER`: every object of a folder or ZIP in one command."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import typer

from api.client.client import Client
from api.client.reports import open_client
from api.uploads import name_of_upload
from service.cli import emit
from service.model.errors import InputError
from service.model.states import AssetKind
from service.store.descriptions import json_object
from service.store.asset_summary import verdict_line
from service.store.assets import pack
from service.store.object_sets import SUFFIXES, Objects


def one_of_set(path: Path, name: str | None) -> Objects:
    """A mesh file as a set of one object; InputError for anything else."""
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        raise InputError(f"several sizes are made of a mesh file or a folder of them, not of {path}")
    return {name or name_of_upload(path.name): {path.name: path.read_bytes()}}


def sweep(objects: Objects, sizes: Sequence[float]) -> Objects:
    """Each object in each size [m]: `mug` at 0.08 is `mug-80mm`."""
    made: Objects = {}
    for name, files in objects.items():
        mesh = next(file for file in files if file != "asset.json")
        described = {"file": mesh, **json_object(files.get("asset.json", b"{}"), "asset.json")}
        for size in sizes:
            text = json.dumps(described | {"scale_to": size})
            made[f"{name}-{1000 * size:g}mm"] = files | {"asset.json": text.encode()}
    return made


def name_of_set(path: Path) -> str:
    """Name of the set that a folder or ZIP becomes."""
    place = path.resolve()
    return name_of_upload(f"{place.name}.zip" if place.is_dir() else place.name)


def add_set(
    objects: Objects,
    *,
    name: str,
    prefix: str | None,
    options: dict[str, Any],
    shared: bool = False,
    wait: bool,
    url: str | None,
    json: bool,
) -> None:
    """Upload all, wait for all checks, give them a name together; what is refused does not stop the others.

    Raises:
        InputError: some were refused; each is listed before.
    """
    with open_client(url) as client:
        say = None if json else typer.echo
        told = upload_set(client, objects, prefix=prefix, options=options, shared=shared, wait=wait, say=say)
        taken = [one["name"] for one in told if one["verdict"] != "refuse"]
        if taken:
            client.add_object_set(name, taken)
    refused = [one["name"] for one in told if one["verdict"] == "refuse"]
    if json:
        emit({"objects": told, "refused": refused, "set": name if taken else None})
    elif taken:
        typer.echo(f"set {name}: {len(taken)} objects; `graspd datasets create NAME --hands HANDS --objects {name}`")
    if refused:
        raise InputError(f"{len(refused)} of {len(told)} objects were refused: {', '.join(refused[:5])}")


def upload_set(
    client: Client,
    objects: Objects,
    *,
    prefix: str | None = None,
    options: dict[str, Any] | None = None,
    shared: bool = False,
    wait: bool = True,
    say: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Upload objects and wait for their checks: name, verdict, message and repairs of each.

    Args:
        say: told of each as soon as its check is done.
    """
    told = [
        _upload(client, f"{prefix}-{name}" if prefix else name, files, options or {}, shared=shared)
        for name, files in objects.items()
    ]
    for one in told:
        if wait and one["verdict"] is None:
            asset = client.wait_checked(AssetKind.OBJECT, one["digest"])
            one.update(verdict=asset.verdict, message=asset.message or "", repairs=asset.repairs)
        if say is not None:
            say(verdict_line(one))
    return told


def _upload(
    client: Client, name: str, files: dict[str, bytes], options: dict[str, Any], *, shared: bool
) -> dict[str, Any]:
    """One object of a set: its name and what is known of it yet."""
    try:
        with tempfile.TemporaryDirectory(prefix="graspd-set-") as folder:
            archive = Path(folder) / "object.zip"
            archive.write_bytes(pack(files))
            asset = client.upload(AssetKind.OBJECT, archive, name=name, options=options, shared=shared)
    except InputError as error:
        return {"name": name, "verdict": "refuse", "message": str(error), "repairs": []}
    return {
        "name": asset.name,
        "digest": asset.digest,
        "verdict": asset.verdict,
        "message": asset.message or "",
        "repairs": asset.repairs,
    }
