"""What was guessed of a hand, and what a user says instead: both as keys of an `asset.json`."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Collection, Mapping
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from service.model.errors import ConflictError, InputError

#: Far more than any hand has; the largest in use have some sixty joints.
MAX_ENTRIES: Final = 256
#: No palm lies farther from its link's frame [m].
MAX_CENTRE_M: Final = 2.0
#: Numbers in messages and in glTF are rounded.
_ROUNDING: Final = 1e-6

Text = Annotated[str, StringConstraints(min_length=1, max_length=255)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Length = Annotated[float, Field(ge=-MAX_CENTRE_M, le=MAX_CENTRE_M)]
Share = Annotated[float, Field(ge=-1e3, le=1e3)]
Direction = Literal[-1, 0, 1]


class _Said(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PalmCorrection(_Said):
    """The palm in the frame of a link, the hand in its pre-shape. What is left out is guessed again."""

    link: Text
    centre: tuple[Length, Length, Length] | None = Field(None, description="where it takes hold [m]")
    approach: tuple[Share, Share, Share] | None = Field(None, description="direction out of the palm; any length")


class HandCorrections(_Said):
    """What a user says of a hand where graspd guessed wrongly. What is left out stays as it was found."""

    palm: PalmCorrection | None = None
    closing: dict[Text, Direction] = Field(
        default_factory=dict, max_length=MAX_ENTRIES, description="how a joint closes the hand; 0: it spreads"
    )
    preshape: dict[Text, Finite] = Field(
        default_factory=dict, max_length=MAX_ENTRIES, description="joint values on approach [rad or m]"
    )
    fingertips: list[Text] | None = Field(None, min_length=1, max_length=MAX_ENTRIES, description="links")


class HandFacts(BaseModel):
    """What the model of a hand tells of it (`worker.stages.glb`)."""

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
    """Those at and below the root."""
    bodies: list[str]
    """Of these, the root and those that a joint moves."""


def facts_of(model: bytes) -> HandFacts:
    """What the binary glTF of a hand says of it.

    Raises:
        ConflictError: it says too little: it was made by an older version.
    """
    try:
        (length,) = struct.unpack("<I", model[12:16])
        document = json.loads(model[20 : 20 + length])
        extras = document["asset"]["extras"]
        bodies = [node["name"] for node in document["nodes"]]
        return HandFacts.model_validate(extras["facts"] | {"links": list(extras["links"]), "bodies": bodies})
    except (struct.error, ValueError, KeyError, TypeError, ValidationError):
        raise ConflictError(
            "the model of this hand was made by an older version and tells too little; correct it with "
            "`graspd hands check --write`"
        ) from None


def described(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Keys of an `asset.json` that say what was found or guessed: root, palm, pre-shape, closing, fingertips."""
    root = facts["root"]
    return {
        "root": root,
        "palm": {"link": root, "centre": facts["palm_centre"], "approach": facts["palm_approach"]},
        "preshape": facts["preshape"],
        "closing": facts["closing"],
        "fingertips": facts["fingertips"],
    }


def corrected(said: Mapping[str, Any], facts: HandFacts, corrections: HandCorrections) -> dict[str, Any]:
    """An `asset.json` that says all that was said, found and corrected, so that nothing is left to guess.

    The pre-shape of a joint that closes another way is guessed anew unless it is given.

    Raises:
        InputError: a link or a joint that the hand does not have, a value out of its limits, or no direction.
    """
    _check(facts, corrections)
    found = described(facts.model_dump())
    turned = {name for name, way in corrections.closing.items() if way != facts.closing[name]}
    found["preshape"] = {name: value for name, value in facts.preshape.items() if name not in turned}
    found["preshape"] |= corrections.preshape
    found["closing"] = facts.closing | corrections.closing
    found["fingertips"] = corrections.fingertips or facts.fingertips
    kept = dict(said)
    if (palm := corrections.palm) is not None:
        kept.pop("approach", None)
        given = palm.model_dump(exclude_none=True, mode="json")
        found["palm"] = (found["palm"] if palm.link == facts.root else {}) | given
    return kept | found


def _check(facts: HandFacts, corrections: HandCorrections) -> None:
    for joint in (*corrections.closing, *corrections.preshape):
        if joint not in facts.dofs:
            raise InputError(f"the hand has no joint {joint!r} of its own; there are: {_few(facts.dofs)}")
    for joint, value in corrections.preshape.items():
        low, high = facts.lower[joint], facts.upper[joint]
        if not low - _ROUNDING <= value <= high + _ROUNDING:
            raise InputError(f"the pre-shape of {joint!r} is {value:g}, outside its limits {low:.4g} .. {high:.4g}")
    for tip in corrections.fingertips or ():
        if tip not in facts.bodies[1:]:
            raise InputError(f"{tip!r} is no link that a joint moves; there are: {_few(facts.bodies[1:])}")
    if (palm := corrections.palm) is None:
        return
    if palm.link not in facts.links:
        raise InputError(f"the hand has no link {palm.link!r} at or below its root; there are: {_few(facts.links)}")
    if palm.approach is not None and math.hypot(*palm.approach) < _ROUNDING:
        raise InputError("the approach is no direction; give one such as 0, 0, 1")


def _few(names: Collection[str]) -> str:
    return ", ".join(list(names)[:8]) + (", ..." if len(names) > 8 else "")
