"""The fields of `JobOptions` as options of a command: a new field is a new option, with its type, default and words."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Iterable
from typing import Annotated, Any, Final, Literal, TypeVar, get_origin

import typer
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from service.model.base import words
from service.model.domain import JobOptions
from service.model.errors import InputError
from service.model.fidelity import OFFERED

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


def validated(model: type[ModelT], values: dict[str, Any]) -> ModelT:
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
