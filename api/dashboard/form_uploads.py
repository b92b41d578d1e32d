"""The hand and the object of the form of a job: a known one, or a file of the user's.

What a form shows is what it runs. A file that was refused is neither forgotten nor replaced by a known object: it lies
in the store, the form names it, and the next press checks it again under the options that the form then has. What a
refusal suggests are buttons of the form: a visitor need not know the options of a command line.
"""

from __future__ import annotations

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
from graspd.service.store.descriptions import json_object

_CHECK_WAIT_S: Final = 15.0
UNITS: Final = (("m", "metres"), ("mm", "millimetres"), ("cm", "centimetres"), ("in", "inches"))
#: What a button says of the option that it sets.
_FIXES: Final = {
    "keep_largest": "Keep the largest part alone",
    "compound": "Take the parts as one rigid body",
    "allow_open": "Take it as it is, open",
}
#: Options whose value a visitor chooses: label of the field, its attributes, what the button says.
_ASKED: Final = {
    "scale_to": ("Longest side [mm]", 'type="number" min="1" max="3000" step="any"', "Scale it to this size"),
    "root": ("Link", 'type="text" maxlength="200"', "Begin the hand there"),
}
#: The field of a kind's file.
FILE_FIELDS: Final = {AssetKind.HAND: "hand_file", AssetKind.OBJECT: "file"}


@dataclass(frozen=True)
class Fix:
    """A button that checks a refused file again."""

    value: str
    """Keys of `asset.json` that it sets, as JSON; a value of null stands for the field beside the button."""
    words: str
    asks: str = ""
    """The key whose value is in a field beside the button; empty: none."""
    label: str = ""
    attributes: str = ""


@dataclass(frozen=True)
class Refusal:
    """Why a file cannot be used, in words for a page."""

    problem: str
    fixes: tuple[Fix, ...] = ()


@dataclass(frozen=True)
class AssetChoice:
    """What a form says of its hand or its object."""

    name: str = ""
    """Of the asset that the job gets; empty: there is none yet."""
    refused: Refusal | None = None
    """Why there is none."""
    file: str = ""
    """How a file that cannot be used is called."""
    held: str = ""
    """Digest under which that file lies in the store; empty: it has to be chosen again."""

    def place(self, kind: AssetKind) -> str:
        """The field of the form that a refusal belongs to."""
        return FILE_FIELDS[kind] if self.file else kind.value


def chosen(request: Request, assets: Assets, fields: FormData, kind: AssetKind) -> AssetChoice:
    """The hand or object that a submitted form means: its file, else the file that it holds, else the known one."""
    file, known = fields.get(FILE_FIELDS[kind]), _text(fields, kind.value)
    if isinstance(file, UploadFile) and file.filename:
        try:
            asset = _store(request, assets, kind, file, _units(fields))
        except InputError as error:
            return AssetChoice(refused=Refusal(str(error)), file=file.filename)
        return _checked(assets, asset)
    if known:
        return AssetChoice(name=known)
    if held := _text(fields, f"{kind.value}_held"):
        try:
            return _checked(assets, _again(assets, kind, held, fields))
        except InputError as error:
            return AssetChoice(refused=Refusal(str(error)), file=held, held=held)
    return AssetChoice(refused=Refusal(f"choose a known {kind.value}, or a file"))


def refusal_of(asset: AssetView) -> Refusal:
    """What the check of an asset says, with the options that it suggests as buttons.

    What an upload says of itself stands beside what its check found, so facts may be of any type.
    """
    facts = asset.facts
    lengths = facts.get("lengths_m")
    units = [
        Fix(json.dumps({"units": unit}), f"Read it as {words}" + _length(lengths, unit))
        for unit in _entries(facts, "units_suggested")
        if isinstance(unit, str) and (words := dict(UNITS).get(unit))
    ]
    others = [
        fix for one in _entries(facts, "options_suggested") if isinstance(one, dict) and (fix := _fix(one)) is not None
    ]
    problem = facts.get("problem")
    return Refusal(str(problem or asset.message or "it was refused"), (*units, *others))


def _entries(facts: Mapping[str, Any], key: str) -> list[Any]:
    found = facts.get(key)
    return found if isinstance(found, list) else []


def _length(lengths: Any, unit: str) -> str:
    length = lengths.get(unit) if isinstance(lengths, dict) else None
    return f": {1e3 * length:.3g} mm long" if isinstance(length, int | float) else ""


def _fix(options: dict[str, Any]) -> Fix | None:
    """The button of suggested options; None: this form has no words for them."""
    ((key, value),) = options.items() if len(options) == 1 else (("", None),)
    if key in _ASKED and value is None:
        label, attributes, words = _ASKED[key]
        return Fix(json.dumps(options), words, key, label, attributes)
    if key in _FIXES:
        words = _FIXES[key]
    elif key == "root":
        words = f"Begin the hand at {value}"
    elif key == "fix" and isinstance(value, dict):
        words = "Fix " + ", ".join(f"{joint} at {at}" for joint, at in value.items())
    else:
        return None
    return Fix(json.dumps(options), words)


def _store(request: Request, assets: Assets, kind: AssetKind, file: UploadFile, units: str) -> AssetView:
    options = json.dumps({"units": units}) if kind is AssetKind.OBJECT and units != "m" else ""
    limit = request.app.state.settings.max_upload_bytes
    return store_upload(assets, kind, file, None, limit_bytes=limit, options=options, rename=True)


def _again(assets: Assets, kind: AssetKind, digest: str, fields: FormData) -> AssetView:
    """The same file under the units that the form has now, or what the pressed button suggests."""
    before, said = assets.one(kind, digest), pressed(fields, kind)
    if not said and kind is AssetKind.OBJECT and (units := _units(fields)) != _text(fields, "held_units"):
        said = {"units": units}
    if not said:
        return before
    files = assets.files(before)
    stated = json_object(asset_json(files), "asset.json")
    for key, value in said.items():
        known = stated.get(key)
        stated[key] = {**known, **value} if isinstance(known, dict) and isinstance(value, dict) else value
    return assets.add(kind, before.name, {**files, "asset.json": json.dumps(stated).encode()}, rename=True)


def pressed(fields: FormData, kind: AssetKind) -> dict[str, Any]:
    """Options of the button that was pressed instead of the form's own, each value of null from its field.

    Raises:
        InputError: its field is empty, or holds no number where one is asked for.
    """
    said = json_object(text, "the option") if (text := _text(fields, f"{kind.value}_fix")) else {}
    for key in [key for key, value in said.items() if value is None and key in _ASKED]:
        label, given = _ASKED[key][0], _text(fields, f"{kind.value}_{key}").strip()
        try:
            said[key] = float(given) / 1e3 if key == "scale_to" else given
        except ValueError:
            raise InputError(f"{label}: {given[:20]!r} is no number") from None
        if not given:
            raise InputError(f"{label}: fill it in first")
    return said


def _checked(assets: Assets, asset: AssetView) -> AssetChoice:
    """Give a worker a moment to check an upload, so that one press of the button is enough."""
    deadline = time.monotonic() + _CHECK_WAIT_S
    while asset.verdict is None and time.monotonic() < deadline:
        time.sleep(0.2)
        asset = assets.one(asset.kind, asset.digest)
    if asset.verdict == "refuse":
        return AssetChoice(refused=refusal_of(asset), file=asset.name, held=asset.digest)
    return AssetChoice(name=asset.name)


def choices(assets: Assets, kind: AssetKind, shown: str, one: AssetChoice) -> list[tuple[str, str]]:
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
    # Of several versions of a name the newest is meant.
    newest = {asset.name: asset for asset in reversed(known)}
    return [
        (name, name if one.builtin or one.verdict else f"{name} (being checked)")
        for name, one in sorted(newest.items())
    ]


def _text(fields: FormData, name: str) -> str:
    value: Any = fields.get(name)
    return value if isinstance(value, str) else ""


def _units(fields: FormData) -> str:
    units = _text(fields, "units")
    return units if units in dict(UNITS) else "m"
