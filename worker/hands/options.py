"""Options of a hand in addition to its URDF: facts that a URDF cannot contain or often states wrongly."""

import json
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from graspd.service.model.base import first_error
from graspd.service.model.errors import HandError
from graspd.worker.objects.options import stated_options

Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]

#: Default position gain of joints, Kp [N m/rad]: the value of the DexGraspBench protocol.
DEFAULT_STIFFNESS: Final = 5.0
#: Default for sliding joints and each pad of a gripper [N/m]: the revolute default at a lever of 5 cm. Stiffer drives
#: lose their force in soft contacts and in gaps of half a millimetre.
DEFAULT_LINEAR_STIFFNESS: Final = 2_000.0
#: Default torque limit [N m] if the URDF gives none or 0: FRoGGeR's value for the Allegro hand.
DEFAULT_EFFORT: Final = 0.7
#: Default force limit [N] of sliding joints and each pad of a gripper: two such pads reach the 50 N of a squeeze.
DEFAULT_FORCE: Final = 25.0


class _Options(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PalmOptions(_Options):
    """Point and direction of the palm in the frame of `link`."""

    link: str
    centre: Vector | None = None
    approach: Vector | None = None


class Coupling(_Options):
    """joint = multiplier * of + offset."""

    of: str
    multiplier: Finite = 1.0
    offset: Finite = 0.0


class HandOptions(_Options):
    """Keys of a hand's `asset.json`. Joints and links have their URDF names; units are SI."""

    file: str = ""
    description: str = ""
    licence: str = ""
    source: str = ""
    facts: dict[str, Any] = Field(default_factory=dict)
    xacro: dict[str, str] = Field(default_factory=dict, description="values of the arguments of a xacro file")
    root: str | None = Field(None, description="link that becomes the root; only links below it remain")
    drop: tuple[str, ...] = Field((), description="links to leave out, with all links below them")
    fix: dict[str, Finite] = Field(default_factory=dict, description="joints frozen at a value [rad or m]")
    couplings: dict[str, Coupling] = Field(default_factory=dict, description="couplings that the URDF lacks")
    tendons: dict[str, dict[str, Finite]] | None = Field(
        None, description="drives that pull several joints, and the coefficient of each joint; {}: none"
    )
    shapes: Literal["collision", "visual"] = Field("collision", description="elements that can touch objects")
    palm: Annotated[PalmOptions | None, BeforeValidator(lambda v: {"link": v} if isinstance(v, str) else v)] = None
    approach: Vector | None = Field(None, description="direction out of the palm, palm link frame")
    preshape: dict[str, Finite] = Field(default_factory=dict, description="joint values on the approach")
    closing: dict[str, int] = Field(default_factory=dict, description="sign of a joint's closing motion: -1, 0 or +1")
    fingertips: tuple[str, ...] = ()
    stiffness: Finite | dict[str, Finite] | None = None
    effort: Finite | dict[str, Finite] | None = None


def parse_options(files: Mapping[str, bytes], extra: Mapping[str, Any] | None = None) -> HandOptions:
    """Return options of the hand in `files`: `extra` overrides `asset.json`, which overrides `hand.json`.
    Raises HandError: one of them is not JSON, or a key is unknown or wrong; the message names it."""
    stated = {**stated_options(files, HandError), **(extra or {})}
    try:
        return HandOptions.model_validate({**_hand_json(files, stated.get("file")), **stated})
    except ValidationError as error:
        place = "asset.json" if error.errors()[0]["loc"][0] in stated else "hand.json"
        raise HandError(f"{place}: {first_error(error)}") from None


def _hand_json(files: Mapping[str, bytes], urdf: object) -> dict[str, Any]:
    """Return options from a collection's `hand.json`; none if it describes another file than `urdf`."""
    if "hand.json" not in files:
        return {}
    options: dict[str, Any] = {}
    try:
        notes = json.loads(files["hand.json"])
        noted = notes.get("urdf", urdf)
        if noted is not None and not _is_same_urdf(noted, files, urdf):
            return {}
        if "palm_link" in notes:
            options["palm"] = {"link": notes["palm_link"], "approach": notes.get("palm_normal_in_palm_link")}
            # Forearm and wrist do not grasp: links above the palm are left out.
            options["root"] = notes["palm_link"]
        if notes.get("fingertips"):
            options["fingertips"] = list(dict(notes["fingertips"]).values())
        limits = [value for key, value in notes.get("physical", {}).items() if key.startswith("torque_limit_Nm")]
        if limits:
            options["effort"] = float(limits[0])
    except (ValueError, TypeError, AttributeError, RecursionError):
        raise HandError("hand.json is not a readable description of a hand; correct or remove it") from None
    return options


def _is_same_urdf(noted: str, files: Mapping[str, bytes], urdf: object) -> bool:
    """Check whether `hand.json` names this URDF; only the file names are compared."""
    named = [name for name in files if PurePosixPath(name).name == PurePosixPath(noted).name]
    return bool(named) and PurePosixPath(str(urdf or noted)).name == PurePosixPath(noted).name
