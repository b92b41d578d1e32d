"""`asset.json`, a small JSON object in an asset, and corrections of guessed values of a hand."""

import json
import math
import struct
from collections.abc import Collection, Mapping
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints, ValidationError
from pydantic_core import from_json, to_json

from graspd.service.model.base import Model, first_error
from graspd.service.model.errors import ConflictError, InputError

#: Size limits [bytes] of `asset.json` and of its facts, which lists of assets contain; built-in hands have 2 kB.
MAX_BYTES: Final = 64 << 10
MAX_FACTS_BYTES: Final = 8 << 10
_MAX_DEPTH: Final = 6
_MAX_NUMBER: Final = 2**53
_BOM: Final = b"\xef\xbb\xbf"


def _check_facts_size(facts: dict[str, Any]) -> dict[str, Any]:
    if len(to_json(facts)) > MAX_FACTS_BYTES:
        raise ValueError(f"the facts take more than {MAX_FACTS_BYTES} bytes; leave some out")
    return facts


class AssetDescription(BaseModel):
    """Keys of `asset.json` that the service reads. Other keys are for the worker, which validates them."""

    model_config = ConfigDict(extra="allow", frozen=True)

    file: str = Field(min_length=1, max_length=255, description="main file: the URDF or the mesh")
    description: str = Field("", max_length=2000)
    licence: str = Field("", max_length=500)
    source: str = Field("", max_length=2000)
    facts: Annotated[dict[Annotated[str, Field(max_length=100)], Any], AfterValidator(_check_facts_size)] = Field(
        default_factory=dict
    )


def parse_description(data: bytes, what: str) -> AssetDescription:
    """Parse `asset.json` of the asset `what`; InputError if it is invalid."""
    given = parse_json_object(data, f"{what}: asset.json")
    try:
        return AssetDescription.model_validate(given)
    except ValidationError as error:
        problem = first_error(error)
        raise InputError(f"{what}: asset.json must name the main file and have short facts: {problem}") from None


def parse_json_object(text: bytes | str, what: str) -> dict[str, Any]:
    """Parse a JSON object, named `what` in messages; InputError above limits of size, depth or numbers."""
    data = text.encode(errors="replace") if isinstance(text, str) else text
    if len(data) > MAX_BYTES:
        raise InputError(f"{what} has more than {MAX_BYTES} bytes; leave out what is not needed")
    try:
        value = from_json(data.removeprefix(_BOM), allow_inf_nan=False)
    except ValueError:
        value = None
    if not isinstance(value, dict):
        raise InputError(f'{what} must be a JSON object such as {{"units": "mm"}}')
    if not _is_within_limits(value, _MAX_DEPTH):
        raise InputError(f"{what} is nested more than {_MAX_DEPTH} deep, or holds a number above 2^53")
    return value


def _is_within_limits(value: Any, depth: int) -> bool:
    if isinstance(value, dict | list):
        inner = value.values() if isinstance(value, dict) else value
        return depth > 0 and all(_is_within_limits(part, depth - 1) for part in inner)
    return not isinstance(value, int) or abs(value) <= _MAX_NUMBER


#: Limit on joints and fingertips; the largest hands in use have about sixty joints.
MAX_ENTRIES: Final = 256
MAX_CENTRE_M: Final = 2.0
#: Tolerance for rounded numbers in messages and glTF.
_ROUNDING: Final = 1e-6

Text = Annotated[str, StringConstraints(min_length=1, max_length=255)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Length = Annotated[float, Field(ge=-MAX_CENTRE_M, le=MAX_CENTRE_M)]
Share = Annotated[float, Field(ge=-1e3, le=1e3)]
Direction = Literal[-1, 0, 1]


class PalmCorrection(Model):
    """Palm of the hand in its pre-shape. Missing values are guessed again."""

    link: Text
    centre: tuple[Length, Length, Length] | None = Field(None, description="origin of the palm in the link [m]")
    approach: tuple[Share, Share, Share] | None = Field(None, description="direction out of the palm, of any length")


class HandCorrections(Model):
    """Corrections of guessed values of a hand. Missing values are not corrected."""

    palm: PalmCorrection | None = None
    closing: dict[Text, Direction] = Field(
        default_factory=dict, max_length=MAX_ENTRIES, description="closing direction of a joint; 0: it spreads"
    )
    preshape: dict[Text, Finite] = Field(
        default_factory=dict, max_length=MAX_ENTRIES, description="joint values on approach [rad or m]"
    )
    fingertips: list[Text] | None = Field(None, min_length=1, max_length=MAX_ENTRIES, description="fingertip links")


class HandFacts(BaseModel):
    model_config = ConfigDict(frozen=True)

    root: str
    palm_centre: list[float] = Field(min_length=3, max_length=3)
    palm_approach: list[float] = Field(min_length=3, max_length=3)
    dofs: list[str]
    lower: dict[str, float]
    upper: dict[str, float]
    preshape: dict[str, float]
    closing: dict[str, int]
    fingertips: list[str]
    links: list[str]
    """Links at and below the root."""
    bodies: list[str]
    """Those of these links that are the root or moved by a joint."""


def read_document(model: bytes) -> dict[str, Any]:
    """Return the JSON document of binary glTF; struct.error or ValueError if there is none."""
    (length,) = struct.unpack("<I", model[12:16])
    return dict(json.loads(model[20 : 20 + length]))


def read_hand_facts(model: bytes) -> HandFacts:
    """Read the facts in the binary glTF of a hand; ConflictError for a model of an older version."""
    try:
        document = read_document(model)
        extras = document["asset"]["extras"]
        bodies = [node["name"] for node in document["nodes"]]
        return HandFacts.model_validate(extras["facts"] | {"links": list(extras["links"]), "bodies": bodies})
    except (struct.error, ValueError, KeyError, TypeError, ValidationError):
        raise ConflictError(
            "the model of this hand is of an older version, without joint limits; use `graspd hands check --write`"
        ) from None


def description_of(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return found or guessed values as keys of `asset.json`: root, palm, pre-shape, closing, fingertips."""
    palm = {"link": facts["root"], "centre": facts["palm_centre"], "approach": facts["palm_approach"]}
    return {"palm": palm, **{name: facts[name] for name in ("root", "preshape", "closing", "fingertips")}}


def apply_corrections(given: Mapping[str, Any], facts: HandFacts, corrections: HandCorrections) -> dict[str, Any]:
    """Return an `asset.json` with given, found and corrected values; InputError for an invalid correction."""
    _check_corrections(facts, corrections)
    found = description_of(facts.model_dump())
    reversed_joints = {joint for joint, sign in corrections.closing.items() if sign != facts.closing[joint]}
    preshape = {joint: value for joint, value in facts.preshape.items() if joint not in reversed_joints}
    found["preshape"] = preshape | corrections.preshape
    found["closing"] = facts.closing | corrections.closing
    found["fingertips"] = corrections.fingertips or facts.fingertips
    kept = dict(given)
    if (palm := corrections.palm) is not None:
        kept.pop("approach", None)
        palm_of_root = found["palm"] if palm.link == facts.root else {}
        found["palm"] = palm_of_root | palm.model_dump(exclude_none=True, mode="json")
    return kept | found


def _check_corrections(facts: HandFacts, corrections: HandCorrections) -> None:
    for joint in (*corrections.closing, *corrections.preshape):
        if joint not in facts.dofs:
            raise InputError(f"the hand has no joint {joint!r} of its own; there are: {_first_names(facts.dofs)}")
    for joint, value in corrections.preshape.items():
        low, high = facts.lower[joint], facts.upper[joint]
        if not low - _ROUNDING <= value <= high + _ROUNDING:
            raise InputError(f"the pre-shape of {joint!r} is {value:g}, outside its limits {low:.4g} .. {high:.4g}")
    for tip in corrections.fingertips or ():
        if tip not in facts.bodies[1:]:
            raise InputError(f"{tip!r} is no link that a joint moves; there are: {_first_names(facts.bodies[1:])}")
    if (palm := corrections.palm) is None:
        return
    if palm.link not in facts.links:
        raise InputError(f"the hand has no link {palm.link!r} at or below its root, but {_first_names(facts.links)}")
    if palm.approach is not None and math.hypot(*palm.approach) < _ROUNDING:
        raise InputError("the approach is no direction; give one such as 0, 0, 1")


def _first_names(names: Collection[str]) -> str:
    return ", ".join(list(names)[:8]) + (", ..." if len(names) > 8 else "")
