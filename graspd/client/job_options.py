"""Spec of a dataset: hands, objects and job options, from command options and a TOML or JSON file."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import Field, model_validator

from graspd.service.command_options import pairs
from graspd.service.model.base import Name, why
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.options import accepted
from graspd.service.model.scene_spec import known_name, scene_option

SpecOption = Annotated[
    Path | None, typer.Option("--spec", help="TOML or JSON file of the dataset; options take precedence.")
]


class Spec(JobOptions):
    """Keys of a spec: those of a job's options, and these."""

    SUBMITTED = True

    name: Name | None = None
    hands: tuple[Name, ...] = ()
    objects: str | tuple[str, ...] = Field((), description="as `--objects`; folders are relative to the spec")
    total_grasps: int | None = Field(
        None, ge=1, description="grasps over all hands and objects, shared evenly; replaces `grasps`"
    )

    @model_validator(mode="after")
    def _one_number(self) -> Spec:
        if self.total_grasps is not None and "grasps" in self.model_fields_set:
            raise ValueError("total_grasps replaces grasps: give one of them")
        return self


@dataclass(frozen=True)
class PlanRequest:
    """Request of a command, from a spec and options."""

    name: str
    hands: str
    objects: str
    options: dict[str, Any]
    total: int | None = None

    def shared_out(self, matrix: dict[str, Any], objects: int) -> dict[str, Any]:
        """Return the matrix with grasps per cell; a total over all cells is divided and rounded up."""
        if self.total is None or not objects:
            return matrix
        return matrix | {"grasps": math.ceil(self.total / (len(matrix["hands"]) * objects))}


def wanted(
    spec: Path | None, *, name: str | None, hands: str | None, objects: str | None, options: dict[str, Any]
) -> PlanRequest:
    """Combine spec and options, which take precedence; the name is empty if neither contains it."""
    given = dict(options)
    if "options" in given:
        given["options"] = pairs(given["options"])
    if "scene" in given:
        given["scene"] = scene_option(given["scene"])
    if "neighbours" in given:
        given["neighbours"] = [known_name(one) for one in given["neighbours"]]
    said = read_spec(spec) if spec is not None else {}
    total = None if "grasps" in given else said.pop("total_grasps", None)
    said.pop("total_grasps", None)
    found_name = name or said.pop("name", "")
    found_hands = hands or ",".join(said.get("hands", ()))
    found_objects = objects or _objects(spec, said.get("objects", ()))
    for what, found in (("hands", found_hands), ("objects", found_objects)):
        if not found:
            raise InputError(f"give the {what}: --{what}, or {what} in the file of --spec")
    rest = {key: value for key, value in said.items() if key not in ("name", "hands", "objects")}
    return PlanRequest(found_name, found_hands, found_objects, {**rest, **given}, total)


def read_spec(file: Path) -> dict[str, Any]:
    """Return the keys of a spec; raise InputError if the file is none."""
    kind, load = ("JSON", json.loads) if file.suffix == ".json" else ("TOML", tomllib.loads)
    try:
        found = load(file.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file} cannot be read: {why(error)}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file} is no {kind}: {error}") from None
    if not isinstance(found, dict):
        raise InputError(f"{file} must hold the keys of a dataset: hands, objects, grasps, ...")
    try:
        if isinstance(found.get("scene"), str):
            found["scene"] = scene_option(found["scene"], beside=file.parent)
        if isinstance(beside := found.get("neighbours"), list):
            found["neighbours"] = [known_name(one) if isinstance(one, str) else one for one in beside]
        spec = accepted(Spec, found)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    return spec.model_dump(mode="json", exclude_unset=True)


def _objects(spec: Path | None, said: Any) -> str:
    if not isinstance(said, str):
        return ",".join(said)
    beside = spec.parent / said if spec is not None else Path(said)
    return str(beside) if "/" in said and beside.exists() else said
