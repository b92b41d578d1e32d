"""Command-line options of a hand or an object, and their values as keys of its `asset.json`."""

import math
from collections.abc import Sequence
from typing import Annotated, Any, Final

import typer
from pydantic import Field

from graspd.service.model.base import Model
from graspd.service.model.errors import InputError
from graspd.service.model.object_options import ASSET, ObjectOptions
from graspd.service.model.options import Option

_TYPED: Final = Option(places=ASSET)


class HandCommandOptions(Model):
    urdf: Annotated[str | None, _TYPED] = Field(
        None, description="main file of the hand in the folder or ZIP (URDF, xacro or MJCF): NAME"
    )
    xacro: Annotated[tuple[str, ...], _TYPED] = Field((), description="arguments of a xacro file: NAME=VALUE")
    palm: Annotated[str | None, _TYPED] = Field(None, description="link of the palm")
    approach: Annotated[str | None, _TYPED] = Field(
        None, description="approach direction out of the palm, in the palm's frame: x,y,z"
    )
    root: Annotated[str | None, _TYPED] = Field(None, description="root link; links above it are omitted")
    pre_shape: Annotated[tuple[str, ...], _TYPED] = Field((), description="joint values on approach: JOINT=VALUE,...")
    closing: Annotated[tuple[str, ...], _TYPED] = Field(
        (), description="closing direction of joints, -1, 0 (spreads) or 1: JOINT=-1,..."
    )
    fingertips: Annotated[str | None, _TYPED] = Field(None, description="links at the ends of the fingers: A,B,C")
    fix: Annotated[tuple[str, ...], _TYPED] = Field((), description="joints to freeze (rad, m): JOINT=VALUE,...")
    drop: Annotated[tuple[str, ...], _TYPED] = Field((), description="link to remove, with all its descendants")


class ObjectSizeOptions(ObjectOptions):
    """Options of an object, with several sizes for `--scale-to`."""

    scale_to: Annotated[str | None, _TYPED] = Field(  # type: ignore[assignment]
        None, description="longest extent after scaling [m]; 0.06,0.08,0.1: one object per size"
    )


LicenceOption = Annotated[str | None, typer.Option("--licence", help="Licence for dataset cards, such as CC-BY-4.0.")]
SourceOption = Annotated[str | None, typer.Option("--source", help="Source: a URL or a citation.")]


def provenance(licence: str | None, source: str | None) -> dict[str, Any]:
    return {key: value for key, value in (("licence", licence), ("source", source)) if value}


def hand_options(**given: Any) -> dict[str, Any]:
    """Convert options of `HandCommandOptions` to keys of a hand's `asset.json`; omit absent options."""
    words = HandCommandOptions(**given)
    options: dict[str, Any] = {
        "file": words.urdf,
        "xacro": dict(map(_parse_xacro_argument, words.xacro)),
        "palm": {"link": words.palm} if words.palm else None,
        "approach": _parse_vector(words.approach) if words.approach else None,
        "root": words.root,
        "preshape": _parse_assignments("--pre-shape", words.pre_shape) if words.pre_shape else None,
        "closing": _parse_closing(words.closing) if words.closing else None,
        "fingertips": [link for part in (words.fingertips or "").split(",") if (link := part.strip())],
        "fix": _parse_assignments("--fix", words.fix) if words.fix else None,
        "drop": list(words.drop),
    }
    return {key: value for key, value in options.items() if value}


def parse_sizes(text: str | None) -> tuple[float, ...]:
    """Parse the distinct sizes of `--scale-to` [m]."""
    try:
        sizes = tuple(dict.fromkeys(float(part) for part in text.split(","))) if text else ()
    except ValueError:
        sizes = (0.0,)
    if not all(0 < size < math.inf for size in sizes):
        raise InputError(f"--scale-to {text!r} must be a size in metres, or several: 0.06,0.08,0.1")
    return sizes


def _parse_vector(text: str) -> list[float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--approach {text!r} must be three numbers: 0,0,1") from None
    return [x, y, z]


def _parse_assignments(option: str, texts: Sequence[str]) -> dict[str, float]:
    values: dict[str, float] = {}
    for text in ",".join(texts).split(","):
        name, _, value = text.strip().partition("=")
        try:
            values[name] = float(value)
        except ValueError:
            raise InputError(f"{option} {text!r} must be JOINT=VALUE with a number") from None
    return values


def _parse_xacro_argument(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise InputError(f"--xacro {text!r} must be NAME=VALUE")
    return name, value


def _parse_closing(texts: Sequence[str]) -> dict[str, int]:
    values = _parse_assignments("--closing", texts)
    for name, value in values.items():
        if value not in (-1, 0, 1):
            raise InputError(f"--closing {name}={value:g} must be -1, 0 or 1")
    return {name: int(value) for name, value in values.items()}
