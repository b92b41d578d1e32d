"""What an option of a job says of itself besides type, default, bounds and description; and the views that follow.

A field with an `Option` among its metadata is offered to people. The command line, the forms of the dashboard, the
Python signatures and the tables of the documentation are made from `rows`; nothing else declares an option.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import UnionType
from typing import Annotated, Any, Final, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from graspd.service.model.base import bounds_of, range_words, refusal
from graspd.service.model.errors import InputError

ModelT = TypeVar("ModelT", bound=BaseModel)
FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])
#: Who takes an option: a job of the service, the command `graspd synth`, `graspd.synthesize`; the file of an asset.
Place = Literal["job", "synth", "python", "asset"]
EVERYWHERE: Final[tuple[Place, ...]] = ("job", "synth", "python")
JOB: Final[tuple[Place, ...]] = ("job",)
_UNIT: Final = re.compile(r"\[([^\]]+)\]")


@dataclass(frozen=True)
class Form:
    """How a form of the dashboard shows an option."""

    section: Literal["grasps", "scenes"]
    label: str
    hint: str = ""
    choices: Mapping[str, str] = field(default_factory=dict)
    """Values with their words; none: a field to type in."""
    placeholder: str = ""
    cells: bool = False
    """Whether the form of a dataset has it, too."""


@dataclass(frozen=True)
class Option:
    """Metadata of a field that people set."""

    group: Literal["basic", "advanced"] = "advanced"
    places: tuple[Place, ...] = EVERYWHERE
    flags: str = ""
    """Spelling on the command line, several separated by spaces; empty: `--` and the name."""
    keyword: str = ""
    """Spelling in `graspd.synthesize`; empty: the name."""
    typed: str = ""
    """The description where a person types the value, if it differs from that of the HTTP document."""
    schema: int = 0
    """First schema of task messages with the field; 0: all have it."""


@dataclass(frozen=True)
class Row:
    """An option of the table."""

    name: str
    field: FieldInfo
    option: Option

    @property
    def form(self) -> Form | None:
        """How forms show it, if they do."""
        return next((one for one in self.field.metadata if isinstance(one, Form)), None)

    @property
    def flags(self) -> list[str]:
        """Spellings on the command line, as Typer takes them."""
        return self.option.flags.split() or [f"--{self.name.replace('_', '-')}"]

    @property
    def keyword(self) -> str:
        """Spelling in `graspd.synthesize`."""
        return self.option.keyword or self.name

    @property
    def meaning(self) -> str:
        """What a person types there."""
        return self.option.typed or self.field.description or ""

    @property
    def unit(self) -> str:
        """Unit of the value; empty: it has none."""
        found = _UNIT.search(self.meaning)
        return found[1] if found else ""

    @property
    def default(self) -> Any:
        """The value of an option that is not given."""
        return self.field.get_default(call_default_factory=True)

    @property
    def bounds(self) -> dict[str, float]:
        """Bounds of a number by their names in Pydantic: ge, gt, le, lt."""
        return bounds_of(self.field)

    @property
    def range(self) -> str:
        """The bounds in words, such as `at least 0 and at most 3`; empty: there are none."""
        return range_words(self.bounds).removeprefix("must be ")

    @property
    def kind(self) -> Any:
        """bool, int, float, str, a Literal of words, or list[str]: what a command line or a form reads."""
        return _kind(self.field.annotation)


def rows(model: type[BaseModel], place: Place) -> list[Row]:
    """The options of a model that a place takes, basic ones first."""
    found = [
        Row(name, one, option)
        for name, one in model.model_fields.items()
        for option in one.metadata
        if isinstance(option, Option) and place in option.places
    ]
    return sorted(found, key=lambda row: row.option.group != "basic")


def accepted(model: type[ModelT], values: Mapping[str, Any], *, names: Mapping[str, str] | None = None) -> ModelT:
    """A model of what was given.

    Args:
        model: the model.
        values: by names of fields.
        names: fields as the caller spells them, for messages; those left out by their own names.

    Raises:
        InputError: names the first value that cannot be used.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(refusal(error, model, names)) from None


def with_keywords(model: type[BaseModel], place: Place) -> Callable[[FunctionT], FunctionT]:
    """Show each option as a keyword in the signature of a function that takes them as `**options`."""

    def decorate(function: FunctionT) -> FunctionT:
        written = inspect.signature(function)
        own = [one for one in written.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
        options = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=row.default, annotation=text)
            for name, row, text in keywords_of(model, place)
        ]
        function.__signature__ = written.replace(parameters=[*own, *options])  # type: ignore[attr-defined]
        return function

    return decorate


def keywords_of(model: type[BaseModel], place: Place) -> list[tuple[str, Row, str]]:
    """Each option with its spelling as a keyword, and its type as a text."""
    found = rows(model, place)
    return [(row.keyword if place == "python" else row.name, row, type_text(row.field.annotation)) for row in found]


def type_text(annotation: Any) -> str:
    """An annotation as a caller reads it: without bounds, a model as the mapping that makes it."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return type_text(inner[0])
    if origin is Literal:
        return f"Literal[{', '.join(json.dumps(one) for one in inner)}]"
    if origin in (Union, UnionType):
        return " | ".join(dict.fromkeys(map(type_text, inner)))
    if origin is tuple:
        return f"Sequence[{type_text(inner[0])}]"
    if origin is dict:
        return f"Mapping[{', '.join(map(type_text, inner))}]"
    if annotation is None or annotation is type(None):
        return "None"
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return "Mapping[str, Any]"
    return "Any" if annotation is Any else str(annotation.__name__)


def _parts(annotation: Any) -> tuple[Any, ...]:
    return get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)


def _kind(annotation: Any) -> Any:
    while get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    if get_origin(annotation) in (tuple, dict):
        return list[str]
    parts = [one for one in _parts(annotation) if one is not type(None)]
    if len(parts) == 1 and parts[0] is not annotation:
        return _kind(parts[0])
    return annotation if annotation in (bool, int, float) or get_origin(annotation) is Literal else str
