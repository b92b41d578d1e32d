"""What a user says about a hand or an object on the command line, as keys of its `asset.json`."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import typer

from service.model.errors import InputError
from service.model.matter import FRICTION, MASS_KG

PalmOption = Annotated[str | None, typer.Option("--palm", help="Link that is the palm.")]
ApproachOption = Annotated[
    str | None, typer.Option("--approach", help="Direction out of the palm, in the palm's frame: x,y,z.")
]
RootOption = Annotated[
    str | None, typer.Option("--root", help="Link to begin at; a forearm and wrist above it are left out.")
]
PreShapeOption = Annotated[
    list[str] | None,
    typer.Option("--pre-shape", help="Joint values on approach (rad, m): JOINT=VALUE,...; several times."),
]
FixOption = Annotated[
    list[str] | None, typer.Option("--fix", help="Freeze joints (rad, m): JOINT=VALUE,...; several times.")
]
DropOption = Annotated[
    list[str] | None, typer.Option("--drop", help="Leave out a link and all that hangs on it; several times.")
]
UrdfOption = Annotated[
    str | None, typer.Option("--urdf", help="Which URDF, xacro or MJCF of the folder or ZIP is the hand: NAME.")
]
XacroOption = Annotated[
    list[str] | None, typer.Option("--xacro", help="Arguments of a xacro file: NAME=VALUE; several times.")
]
ClosingOption = Annotated[
    list[str] | None,
    typer.Option("--closing", help="How joints close the hand, -1, 0 (spreads) or 1: JOINT=-1,...; several times."),
]
FingertipsOption = Annotated[str | None, typer.Option("--fingertips", help="Links at the ends of the fingers: A,B,C.")]
UnitsOption = Annotated[
    Literal["m", "mm", "cm", "in"] | None, typer.Option("--units", help="Unit of the file; default: metres.")
]
ScaleToOption = Annotated[
    float | None, typer.Option("--scale-to", help="Scale the longest extent to this many metres.")
]
ScaleSweepOption = Annotated[
    str | None,
    typer.Option(
        "--scale-to", help="Scale the longest extent to this many metres; 0.06,0.08,0.1: an object of each size."
    ),
]
CompoundOption = Annotated[bool, typer.Option("--compound", help="Components that lie apart are one rigid body.")]
KeepLargestOption = Annotated[bool, typer.Option("--keep-largest", help="Of several components keep the largest.")]
AllowOpenOption = Annotated[bool, typer.Option("--allow-open", help="Take a mesh that is not watertight.")]
DensityOption = Annotated[
    float | None, typer.Option("--density", help="Density of the object in kg/m3, in place of the mass.")
]
MassOption = Annotated[
    float | None, typer.Option("--mass", help=f"Mass of the object in kg; {MASS_KG:g} where nothing is said.")
]
FrictionOption = Annotated[
    float | None,
    typer.Option(
        "--friction",
        help=f"Coulomb coefficient of the object's contacts in simulation; {FRICTION:g} where none is given.",
    ),
]
LicenceOption = Annotated[
    str | None, typer.Option("--licence", help="Terms it may be used on, for dataset cards: CC-BY-4.0.")
]
SourceOption = Annotated[str | None, typer.Option("--source", help="Where it comes from: an address or a citation.")]


def provenance(licence: str | None, source: str | None) -> dict[str, Any]:
    """Keys of `asset.json` that say whose it is; those not given are left out."""
    return {key: value for key, value in (("licence", licence), ("source", source)) if value}


def hand_options(
    *,
    urdf: str | None = None,
    xacro: list[str] | None = None,
    palm: str | None = None,
    approach: str | None = None,
    root: str | None = None,
    pre_shape: list[str] | None = None,
    closing: list[str] | None = None,
    fingertips: str | None = None,
    fix: list[str] | None = None,
    drop: list[str] | None = None,
) -> dict[str, Any]:
    """Keys of a hand's `asset.json`; those not given are left out.

    Raises:
        InputError: a text is no vector or no JOINT=VALUE.
    """
    options: dict[str, Any] = {
        "file": urdf,
        "xacro": dict(map(_argument, xacro or [])),
        "palm": {"link": palm} if palm else None,
        "approach": _vector(approach) if approach else None,
        "root": root,
        "preshape": _assignments("--pre-shape", pre_shape) if pre_shape else None,
        "closing": _directions(closing) if closing else None,
        "fingertips": [link.strip() for link in fingertips.split(",") if link.strip()] if fingertips else None,
        "fix": _assignments("--fix", fix) if fix else None,
        "drop": drop,
    }
    return {key: value for key, value in options.items() if value}


def object_options(
    *,
    units: str | None = None,
    scale_to: float | None = None,
    keep_largest: bool = False,
    compound: bool = False,
    allow_open: bool = False,
    density: float | None = None,
    mass: float | None = None,
    friction: float | None = None,
) -> dict[str, Any]:
    """Keys of an object's `asset.json`; those not given are left out."""
    options = {
        "units": units,
        "scale_to": scale_to,
        "keep_largest": keep_largest or None,
        "compound": compound or None,
        "allow_open": allow_open or None,
        "density": density,
        "mass": mass,
        "friction": friction,
    }
    return {key: value for key, value in options.items() if value is not None}


def sizes_of(text: str | None) -> tuple[float, ...]:
    """Sizes of `--scale-to` [m]; InputError if one is no positive number."""
    try:
        sizes = tuple(dict.fromkeys(float(part) for part in text.split(","))) if text else ()
    except ValueError:
        sizes = (0.0,)
    if not all(0 < size < math.inf for size in sizes):
        raise InputError(f"--scale-to {text!r} must be a size in metres, or several: 0.06,0.08,0.1")
    return sizes


def _vector(text: str) -> list[float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--approach {text!r} must be three numbers: 0,0,1") from None
    return [x, y, z]


def _assignments(option: str, texts: list[str]) -> dict[str, float]:
    values: dict[str, float] = {}
    for text in ",".join(texts).split(","):
        name, _, value = text.strip().partition("=")
        try:
            values[name] = float(value)
        except ValueError:
            raise InputError(f"{option} {text!r} must be JOINT=VALUE with a number") from None
    return values


def _argument(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise InputError(f"--xacro {text!r} must be NAME=VALUE")
    return name, value


def _directions(texts: list[str]) -> dict[str, int]:
    values = _assignments("--closing", texts)
    for name, value in values.items():
        if value not in (-1, 0, 1):
            raise InputError(f"--closing {name}={value:g} must be -1, 0 or 1")
    return {name: int(value) for name, value in values.items()}
