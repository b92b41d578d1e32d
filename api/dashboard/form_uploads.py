"""Hand and object of a job's form: a known asset, or an uploaded file.

A refused file stays in the store, and the form refers to it: the next submission checks it again with the form's
options. Each fix that a refusal suggests is a button.
"""

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from fastapi import Request
from starlette.datastructures import FormData, UploadFile

from graspd.api.catalog.assets import Assets
from graspd.api.routes.assets import store_upload
from graspd.service.index.views import AssetView
from graspd.service.model.errors import GraspdError, InputError
from graspd.service.model.states import AssetKind
from graspd.service.store.assets import asset_json
from graspd.service.store.descriptions import parse_json_object

_CHECK_WAIT_S: Final = 15.0
UNITS: Final = {"m": "metres", "mm": "millimetres", "cm": "centimetres", "in": "inches"}
#: Text of each button, by the option that the button sets.
_FIXES: Final = {
    "rigid": "Take the parts as one rigid body",
    "keep_largest": "Keep only the largest part",
    "allow_open": "Accept the open mesh",
}
#: Options with a value from the user: label and attributes of the field, text of the button.
_ASKED: Final = {
    "scale_to": ("Longest side [mm]", 'type="number" min="1" max="3000" step="any"', "Scale to this size"),
    "root": ("Link", 'type="text" maxlength="200"', "Use as root link"),
}
FILE_FIELDS: Final = {AssetKind.HAND: "hand_file", AssetKind.OBJECT: "file"}


@dataclass(frozen=True)
class Fix:
    """Button that checks a refused file again."""

    value: str
    """Keys of `asset.json` that the button sets, as JSON; null stands for the value of the field next to the button."""
    words: str
    asks: str = ""
    """Key whose value is in the field next to the button; empty if there is no field."""
    label: str = ""
    attributes: str = ""


@dataclass(frozen=True)
class AssetChoice:
    name: str = ""
    """Name of the job's asset; empty until one is chosen."""
    problem: str = ""
    """Reason why there is none, for a page."""
    fixes: tuple[Fix, ...] = ()
    file: str = ""
    held: str = ""
    """Digest of the file in the store; if empty, the user must choose the file again."""
    message: str = ""
    """Result of the check of an accepted file."""
    shown_in: str = ""
    """Unit in which the 3D view shows a refused file; empty: there is no view."""

    def form_field(self, kind: AssetKind) -> str:
        return FILE_FIELDS[kind] if self.file else kind.value


def choose_asset(request: Request, assets: Assets, fields: FormData, kind: AssetKind) -> AssetChoice:
    """Return the hand or object of a submitted form: an uploaded file, the file that the form refers to, or a known
    asset."""
    file, known = fields.get(FILE_FIELDS[kind]), _field_text(fields, kind.value)
    if isinstance(file, UploadFile) and file.filename:
        try:
            asset = _store_upload(request, assets, kind, file, _chosen_unit(fields))
        except InputError as error:
            return AssetChoice(problem=str(error), file=file.filename)
        return _wait_for_check(assets, asset)
    if held := _field_text(fields, f"{kind.value}_held"):
        try:
            before = assets.get(kind, held)
            if known in ("", before.name):
                return _wait_for_check(assets, _retry_upload(assets, before, fields))
        except InputError as error:
            return AssetChoice(problem=str(error), file=held, held=held)
    if known:
        return AssetChoice(name=known)
    return AssetChoice(problem=f"select a known {kind.value}, or a file")


def _refused(asset: AssetView) -> AssetChoice:
    """Return a refused file. Values in `facts` may come from the upload, so their type is checked."""
    facts = asset.facts
    units = [unit for unit in _list_entries(facts, "units_suggested") if isinstance(unit, str) and unit in UNITS]
    fixes = [
        Fix(json.dumps({"units": unit}), f"Read in {UNITS[unit]}" + _length(facts.get("lengths_m"), unit))
        for unit in units
    ]
    others = [fix for one in _list_entries(facts, "options_suggested") if isinstance(one, dict) and (fix := _fix(one))]
    problem, shown_in = str(facts.get("problem") or asset.message or "refused"), UNITS[units[0]] if units else ""
    return AssetChoice("", problem, (*fixes, *others), asset.name, asset.digest, shown_in=shown_in)


def _list_entries(facts: Mapping[str, Any], key: str) -> list[Any]:
    found = facts.get(key)
    return found if isinstance(found, list) else []


def _length(lengths: Any, unit: str) -> str:
    length = lengths.get(unit) if isinstance(lengths, dict) else None
    return f": {1e3 * length:.3g} mm long" if isinstance(length, int | float) else ""


def _fix(options: dict[str, Any]) -> Fix | None:
    """Return the button for suggested options; None if the form has none for them."""
    ((key, value),) = options.items() if len(options) == 1 else (("", None),)
    if key in _ASKED and value is None:
        label, attributes, words = _ASKED[key]
        return Fix(json.dumps(options), words, key, label, attributes)
    if key in _FIXES:
        words = _FIXES[key]
    elif key == "root":
        words = f"Use {value} as root link"
    elif key == "fix" and isinstance(value, dict):
        words = "Fix " + ", ".join(f"{joint} at {at}" for joint, at in value.items())
    else:
        return None
    return Fix(json.dumps(options), words)


def _store_upload(request: Request, assets: Assets, kind: AssetKind, file: UploadFile, units: str) -> AssetView:
    options = json.dumps({"units": units}) if kind is AssetKind.OBJECT and units != "m" else ""
    limit = request.app.state.settings.max_upload_bytes
    return store_upload(assets, kind, file, None, limit_bytes=limit, options=options, rename=True)


def _retry_upload(assets: Assets, before: AssetView, fields: FormData) -> AssetView:
    """Store the file again, with the options of the pressed button or with changed units."""
    kind = before.kind
    if not (said := fix_options(fields, kind)) and kind is AssetKind.OBJECT:
        units = _chosen_unit(fields)
        said = {"units": units} if units != _field_text(fields, "held_units") else {}
    if not said:
        return before
    files = assets.files(before)
    stated = parse_json_object(asset_json(files), "asset.json")
    for key, value in said.items():
        known = stated.get(key)
        stated[key] = {**known, **value} if isinstance(known, dict) and isinstance(value, dict) else value
    return assets.add(kind, before.name, {**files, "asset.json": json.dumps(stated).encode()}, rename=True)


def fix_options(fields: FormData, kind: AssetKind) -> dict[str, Any]:
    """Return the options of the pressed button, with the value of its field in place of null."""
    said = parse_json_object(text, "the option") if (text := _field_text(fields, f"{kind.value}_fix")) else {}
    for key in [key for key, value in said.items() if value is None and key in _ASKED]:
        label, given = _ASKED[key][0], _field_text(fields, f"{kind.value}_{key}").strip()
        if not given:
            raise InputError(f"{label}: a value is missing")
        try:
            said[key] = float(given) / 1e3 if key == "scale_to" else given
        except ValueError:
            raise InputError(f"{label}: {given[:20]!r} is no number") from None
    return said


def _wait_for_check(assets: Assets, asset: AssetView) -> AssetChoice:
    """Wait at most 15 s for the check of an upload; without a result, choose the unchecked asset."""
    deadline = time.monotonic() + _CHECK_WAIT_S
    while asset.verdict is None and time.monotonic() < deadline:
        time.sleep(0.2)
        asset = assets.get(asset.kind, asset.digest)
    if asset.verdict == "refuse":
        return _refused(asset)
    unchecked = "No worker has checked it yet; start one before you submit."
    return AssetChoice(asset.name, held=asset.digest, message=(asset.message or "") if asset.verdict else unchecked)


def select_choices(assets: Assets, kind: AssetKind, shown: str, one: AssetChoice) -> list[tuple[str, str]]:
    """Return names with their labels, including the name or the refused file that the form shows."""
    known = asset_choices(assets, kind)
    if one.problem:
        return [("", f"your file {one.file} (refused)" if one.file else f"select a {kind.value}"), *known]
    if shown not in dict(known):
        return [(shown, f"{shown} (unknown)" if shown else f"select a {kind.value}"), *known]
    return known


def asset_choices(assets: Assets, kind: AssetKind) -> list[tuple[str, str]]:
    """Return names with their labels, which mark assets whose check has not ended."""
    try:
        known = assets.page(kind, limit=200).items
    except GraspdError:
        return []
    newest = sorted({asset.name: asset for asset in reversed(known)}.items())
    return [(name, name if one.builtin or one.verdict else f"{name} (being checked)") for name, one in newest]


def _field_text(fields: FormData, name: str) -> str:
    return value if isinstance(value := fields.get(name), str) else ""


def shown_unit(fields: FormData) -> str:
    """Return the unit of the pressed button, else the chosen one."""
    fix = _field_text(fields, f"{AssetKind.OBJECT.value}_fix")
    return next((unit for unit in UNITS if fix == json.dumps({"units": unit})), _chosen_unit(fields))


def _chosen_unit(fields: FormData) -> str:
    units = _field_text(fields, "units")
    return units if units in UNITS else "m"
