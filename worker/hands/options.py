"""What a hand's `asset.json` may say beside the URDF: the facts that a URDF cannot hold or often holds wrongly."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any, Final

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from service.errors import HandError

Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]

#: Position gain of the joints, Kp [N m/rad], where nothing is said: the value of the DexGraspBench protocol.
DEFAULT_STIFFNESS: Final = 5.0
#: Torque limit [N m] in place of a placeholder (0, or 5 and more): what FRoGGeR uses for the Allegro hand.
DEFAULT_EFFORT: Final = 0.7
PLACEHOLDER_EFFORT: Final = 5.0


class _Options(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PalmOptions(_Options):
    """Where the hand takes hold, in the frame of `link`."""

    link: str
    centre: Vector | None = None
    approach: Vector | None = None


class Coupling(_Options):
    """joint = multiplier * of + offset."""

    of: str
    multiplier: Finite = 1.0
    offset: Finite = 0.0


def _palm(value: Any) -> Any:
    return {"link": value} if isinstance(value, str) else value


class HandOptions(_Options):
    """The keys of a hand's `asset.json`. Joints and links go by their URDF names; units are SI."""

    file: str = ""
    description: str = ""
    licence: str = ""
    source: str = ""
    facts: dict[str, Any] = Field(default_factory=dict)
    root: str | None = Field(None, description="link that becomes the root; what is not below it is dropped")
    drop: tuple[str, ...] = Field((), description="links to leave out, with all that hangs on them")
    fix: dict[str, Finite] = Field(default_factory=dict, description="joints frozen at a value [rad or m]")
    couplings: dict[str, Coupling] = Field(default_factory=dict, description="couplings that the URDF lacks")
    palm: Annotated[PalmOptions | None, BeforeValidator(_palm)] = None
    approach: Vector | None = Field(None, description="direction out of the palm, palm link frame")
    preshape: dict[str, Finite] = Field(default_factory=dict, description="joint values in which the hand approaches")
    closing: dict[str, int] = Field(default_factory=dict, description="-1, 0, +1: how a joint closes the hand")
    fingertips: tuple[str, ...] = ()
    stiffness: Finite | dict[str, Finite] = DEFAULT_STIFFNESS
    effort: Finite | dict[str, Finite] | None = None


def parse_options(files: Mapping[str, bytes], extra: Mapping[str, Any] | None = None) -> HandOptions:
    """Options of the hand in `files`, with `extra` over what its `asset.json` says.

    Raises:
        HandError: `asset.json` is not JSON, or a key is unknown or wrong; the message names it.
    """
    try:
        stated = json.loads(files["asset.json"]) if "asset.json" in files else {}
        if not isinstance(stated, dict):
            raise HandError("asset.json must hold a JSON object")
    except (ValueError, RecursionError):
        raise HandError('asset.json is not JSON; write an object such as {"file": "hand.urdf"}') from None
    try:
        return HandOptions.model_validate({**stated, **(extra or {})})
    except ValidationError as error:
        first = error.errors()[0]
        raise HandError(f"asset.json: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None
