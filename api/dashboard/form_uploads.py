"""The hand and the object of the form of a job: a known one, or a file of the user's.

What a form shows is what it runs. A file that was refused is neither forgotten nor replaced by a known object: it lies
in the store, the form names it, and the next press checks it again under the options that the form then has.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from typing import Any, Final

from fastapi import Request
from starlette.datastructures import FormData, UploadFile

from api.catalog.assets import Assets
from api.routes.assets import store_upload
from service.index.views import AssetView
from service.model.errors import GraspdError, InputError
from service.model.states import AssetKind
from service.store.descriptions import json_object

_CHECK_WAIT_S: Final = 15.0
UNITS: Final = (("m", "metres"), ("mm", "millimetres"), ("cm", "centimetres"), ("in", "inches"))
#: The field of a kind's file.
FILE_FIELDS: Final = {AssetKind.HAND: "hand_file", AssetKind.OBJECT: "file"}


@dataclass(frozen=True)
class Chosen:
    """What a form says of its hand or its object."""

    name: str = ""
    """Of the asset that the job gets; empty: there is none yet."""
    refused: str = ""
    """Why the file cannot be used."""
    file: str = ""
    """How a file that cannot be used is called."""
    held: str = ""
    """Digest under which that file lies in the store; empty: it has to be chosen again."""

    def field(self, kind: AssetKind) -> str:
        """The field of the form that a refusal belongs to."""
        return FILE_FIELDS[kind] if self.file else kind.value


def chosen(request: Request, assets: Assets, fields: FormData, kind: AssetKind) -> Chosen:
    """The hand or object that a submitted form means: its file, else the file that it holds, else the known one."""
    file, known = fields.get(FILE_FIELDS[kind]), _text(fields, kind.value)
    if isinstance(file, UploadFile) and file.filename:
        try:
            asset = _store(request, assets, kind, file, _units(fields))
        except InputError as error:
            return Chosen(refused=str(error), file=file.filename)
        return _checked(assets, asset)
    if known:
        return Chosen(name=known)
    if held := _text(fields, f"{kind.value}_held"):
        try:
            return _checked(assets, _again(assets, kind, held, fields))
        except InputError as error:
            return Chosen(refused=str(error), file=held, held=held)
    return Chosen(refused=f"choose a known {kind.value}, or a file")


def _store(request: Request, assets: Assets, kind: AssetKind, file: UploadFile, units: str) -> AssetView:
    options = json.dumps({"units": units}) if kind is AssetKind.OBJECT and units != "m" else ""
    limit = request.app.state.settings.max_upload_bytes
    return store_upload(assets, kind, file, None, limit_bytes=limit, options=options)


def _again(assets: Assets, kind: AssetKind, digest: str, fields: FormData) -> AssetView:
    """The same file under the units that the form has now."""
    before, units = assets.one(kind, digest), _units(fields)
    if kind is not AssetKind.OBJECT or units == _text(fields, "held_units"):
        return before
    files = assets.files(before)
    stated = json_object(files["asset.json"], "asset.json")
    return assets.add(kind, before.name, {**files, "asset.json": json.dumps(stated | {"units": units}).encode()})


def _checked(assets: Assets, asset: AssetView) -> Chosen:
    """Give a worker a moment to check an upload, so that one press of the button is enough."""
    deadline = time.monotonic() + _CHECK_WAIT_S
    while asset.verdict is None and time.monotonic() < deadline:
        time.sleep(0.2)
        asset = assets.one(asset.kind, asset.digest)
    if asset.verdict == "refuse":
        return Chosen(refused=asset.message or "it was refused", file=asset.name, held=asset.digest)
    return Chosen(name=asset.name)


def choices(assets: Assets, kind: AssetKind, shown: str, one: Chosen) -> list[tuple[str, str]]:
    """Names to choose from, the one that the form shows always among them."""
    known = asset_choices(assets, kind)
    if one.refused:
        return [("", f"your file {one.file} (refused)" if one.file else f"choose a {kind.value}"), *known]
    if shown not in dict(known):
        return [(shown, f"{shown} (not known here)" if shown else f"choose a {kind.value}"), *known]
    return known


def asset_choices(assets: Assets, kind: AssetKind) -> list[tuple[str, str]]:
    """Names to choose from, with a word on those that cannot be used now."""
    try:
        known = assets.page(kind, limit=200).items
    except GraspdError:
        return []
    notes = {"refuse": " (refused)", None: " (being checked)"}
    # Of several versions of a name the newest is meant.
    newest = {asset.name: asset for asset in reversed(known)}
    return [(name, name + ("" if one.builtin else notes.get(one.verdict, ""))) for name, one in sorted(newest.items())]


def _text(fields: FormData, name: str) -> str:
    value: Any = fields.get(name)
    return value if isinstance(value, str) else ""


def _units(fields: FormData) -> str:
    units = _text(fields, "units")
    return units if units in dict(UNITS) else "m"
