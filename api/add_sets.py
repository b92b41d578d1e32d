"""`graspd objects add FOLDER`: every object of a folder or ZIP in one command."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import typer

from api.client import Client
from api.reports import open_client
from api.uploads import UNPACK_FACTOR
from service.asset_summary import verdict_line
from service.assets import pack
from service.cli import emit, load_settings
from service.domain import AssetKind
from service.errors import InputError
from service.object_sets import object_set, read_set

Objects = dict[str, dict[str, bytes]]


def files_of_set(path: Path) -> Objects | None:
    """Names and files of the objects in a folder, or in a ZIP of several; None if the path is one object.

    Raises:
        InputError: no mesh in the folder, or no readable ZIP.
        LimitError: more than the service would take in one ZIP.
    """
    if not path.is_dir() and not (path.suffix.lower() == ".zip" and path.is_file()):
        return None
    files = read_set(path, limit_bytes=UNPACK_FACTOR * load_settings().max_upload_bytes)
    # A description at the top speaks of one object, however many meshes lie around it.
    if path.is_file() and "asset.json" in files:
        return None
    found = object_set(files)
    return found if path.is_dir() or len(found) > 1 else None


def add_set(
    objects: Objects, *, prefix: str | None, options: dict[str, Any], wait: bool, url: str | None, json: bool
) -> None:
    """Upload all, wait for all checks; what is refused does not stop the others.

    Raises:
        InputError: some were refused; each is listed before.
    """
    told: list[dict[str, Any]] = []
    with open_client(url) as client:
        for name, files in objects.items():
            told.append(_upload(client, f"{prefix}-{name}" if prefix else name, files, options))
        for one in told:
            if wait and one["verdict"] is None:
                asset = client.wait_checked(AssetKind.OBJECT, one["name"])
                one.update(verdict=asset.verdict, message=asset.message or "", repairs=asset.repairs)
            if not json:
                typer.echo(verdict_line(one))
    refused = [one["name"] for one in told if one["verdict"] == "refuse"]
    if json:
        emit({"objects": told, "refused": refused})
    if refused:
        raise InputError(f"{len(refused)} of {len(told)} objects were refused: {', '.join(refused[:5])}")


def _upload(client: Client, name: str, files: dict[str, bytes], options: dict[str, Any]) -> dict[str, Any]:
    """One object of a set: its name and what is known of it yet."""
    try:
        with tempfile.TemporaryDirectory(prefix="graspd-set-") as folder:
            archive = Path(folder) / "object.zip"
            archive.write_bytes(pack(files))
            asset = client.upload(AssetKind.OBJECT, archive, name=name, options=options)
    except InputError as error:
        return {"name": name, "verdict": "refuse", "message": str(error), "repairs": []}
    return {"name": asset.name, "verdict": asset.verdict, "message": asset.message or "", "repairs": asset.repairs}
