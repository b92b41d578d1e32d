"""Job options as options of commands, and as files: each field of `JobOptions` is an option with its type, default and
words; a dataset's spec is TOML or JSON."""

from __future__ import annotations

import functools
import inspect
import json
import math
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar, get_origin

import typer
from pydantic import BaseModel, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo

from graspd.service.model.base import why, words
from graspd.service.model.domain import JobOptions, Name
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import OFFERED
from graspd.service.model.scene_spec import known_name, scene_option

ModelT = TypeVar("ModelT", bound=BaseModel)

_HELP: Final = {
    "grasps": "Grasps for each hand and object.",
    "fidelity": f"{', '.join(OFFERED)}, or auto with --target.",
    "options": "An option of the planner, such as steps=20000; several times.",
    "target": "With auto: gsr>=0.6 or pd_mm<=1, in a scene lift>=0.9; for each cell the cheapest that meets it.",
    "method": "Planner.",
    "seed": "The same seed gives the same grasps.",
    "scene": "Where the grasps are used: free, table, bin, shelf, or a JSON or YAML file.",
    "neighbours": "Another object in each scene, by name; up to eight.",
    "touch": "mm that fingertips keep from supports: 2 as the rest of the hand; 0: they touch; to -1: they press.",
    "faces": "In a scene: drawn, as drops fall, or all, a scene for each stable face.",
}
_SHORT: Final = {"grasps": "-n"}
#: Where a field goes by another word; the name of a dataset is an argument.
_FLAGS: Final = {"options": "--option", "neighbours": "--with", "name": "NAME"}


def with_job_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add an option for each field of `JobOptions`; the command gets those that were given, as `options`."""
    own = [p for p in inspect.signature(command, eval_str=True).parameters.values() if p.name != "options"]
    added = [_parameter(name, field) for name, field in JobOptions.model_fields.items()]

    @functools.wraps(command)
    def wrapper(**given: Any) -> None:
        options = {p.name: given.pop(p.name) for p in added}
        command(**given, options={name: value for name, value in options.items() if value is not None})

    del wrapper.__wrapped__  # its signature is not this one's
    parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in (*own, *added)]
    wrapper.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    wrapper.__annotations__ = {p.name: p.annotation for p in parameters}
    return wrapper


def pairs(texts: Iterable[str]) -> dict[str, str | int | float]:
    """`name=value` of each `--option`, numbers as numbers: the same job as by HTTP. InputError for another form."""
    split = [text.partition("=") for text in texts]
    for name, equals, value in split:
        if not equals:
            raise InputError(f"--option {name + value!r}: write it as name=value, for example steps=20000")
    return {name: _number(value) for name, _, value in split}


def _number(text: str) -> str | int | float:
    for kind in (int, float):
        try:
            number = kind(text)
        except ValueError:
            continue
        # Only what is written as a number is: 007 and nan stay what they are.
        return number if str(number) == text and math.isfinite(number) else text
    return text


def parsed_options(model: type[ModelT], values: dict[str, Any]) -> ModelT:
    """A model of what was given; InputError names the first option that cannot be used."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0]) if first["loc"] else ""
        option = _FLAGS.get(name, f"--{name.replace('_', '-')}")
        raise InputError(f"{option}: {words(first)}" if name else words(first)) from None


def _parameter(name: str, field: FieldInfo) -> inspect.Parameter:
    said = field.description or name
    words = _HELP.get(name) or f"{said[0].upper()}{said[1:]}."
    if get_origin(field.annotation) is tuple:
        words += " Several times."
    flags = [_FLAGS.get(name, f"--{name.replace('_', '-')}"), *([_SHORT[name]] if name in _SHORT else [])]
    if field.annotation is bool:
        option = Annotated[bool, typer.Option(flags[0], help=words)]
        return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=option)
    default = "" if field.default in ((), None, "") or name in _FLAGS else f" Default: {field.default}."
    annotation: Any = Annotated[_type_of(field) | None, typer.Option(*flags, help=words + default, show_default=False)]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def _type_of(field: FieldInfo) -> Any:
    """The type that the command line reads: several choices for a tuple or pairs, a name where knobs could stand."""
    kind = field.annotation
    if get_origin(kind) in (tuple, dict):
        return list[str]
    return kind if kind in (int, float) or get_origin(kind) is Literal else str


SpecOption = Annotated[
    Path | None, typer.Option("--spec", help="TOML or JSON file that says it; options go over what it says.")
]


class Spec(JobOptions):
    """The keys of a spec: those of a job's options, and these."""

    SUBMITTED = True

    name: Name | None = None
    hands: tuple[Name, ...] = ()
    objects: str | tuple[str, ...] = Field((), description="as `--objects`; a folder is looked for beside the spec")
    total_grasps: int | None = Field(
        None, ge=1, description="grasps over all hands and objects, shared evenly, in the place of `grasps`"
    )

    @model_validator(mode="after")
    def _one_number(self) -> Spec:
        if self.total_grasps is not None and "grasps" in self.model_fields_set:
            raise ValueError("total_grasps stands in the place of grasps: say one of them")
        return self


@dataclass(frozen=True)
class PlanRequest:
    """What a command was told, by a spec and by options."""

    name: str
    hands: str
    objects: str
    options: dict[str, Any]
    total: int | None = None

    def shared_out(self, matrix: dict[str, Any], objects: int) -> dict[str, Any]:
        """The matrix with the grasps of each cell, where a number over all cells is wanted: rounded up."""
        if self.total is None or not objects:
            return matrix
        return matrix | {"grasps": math.ceil(self.total / (len(matrix["hands"]) * objects))}


def wanted(
    spec: Path | None, *, name: str | None, hands: str | None, objects: str | None, options: dict[str, Any]
) -> PlanRequest:
    """Spec and options together; what an option says goes before.

    Args:
        spec: file, if one was given.
        name: of the dataset; stays empty where neither names it.
        hands: comma-separated, as `--hands`.
        objects: as `--objects`.
        options: of `with_job_options`.

    Raises:
        InputError: no hands or no objects, no such file, or it holds a key or a value that is not known.
    """
    given = {key: value for key, value in options.items() if value is not False}  # a flag that was not set
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
            raise InputError(f"say which {what}: --{what}, or {what} in the file of --spec")
    rest = {key: value for key, value in said.items() if key not in ("name", "hands", "objects")}
    return PlanRequest(found_name, found_hands, found_objects, {**rest, **given}, total)


def read_spec(file: Path) -> dict[str, Any]:
    """The keys that a spec says; InputError for a file that is none."""
    try:
        text = file.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file} cannot be read: {why(error)}") from None
    try:
        found = json.loads(text) if file.suffix == ".json" else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file} is no {'JSON' if file.suffix == '.json' else 'TOML'}: {error}") from None
    if not isinstance(found, dict):
        raise InputError(f"{file} must hold the keys of a dataset: hands, objects, grasps, ...")
    try:
        if isinstance(found.get("scene"), str):
            found["scene"] = scene_option(found["scene"], beside=file.parent)
        if isinstance(beside := found.get("neighbours"), list):
            found["neighbours"] = [known_name(one) if isinstance(one, str) else one for one in beside]
        spec: Spec = parsed_options(Spec, found)
    except InputError as error:
        raise InputError(f"{file}: {str(error).removeprefix('--')}") from None
    return spec.model_dump(mode="json", exclude_unset=True)


def _objects(spec: Path | None, said: Any) -> str:
    if not isinstance(said, str):
        return ",".join(said)
    beside = spec.parent / said if spec is not None else Path(said)
    return str(beside) if "/" in said and beside.exists() else said
