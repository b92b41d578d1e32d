"""Tables of options: command line, forms, Python signatures and docs derive from `option_rows`."""

import inspect
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import UnionType
from typing import Annotated, Any, Final, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from graspd.service.model.base import bounds_of, first_error, range_text
from graspd.service.model.errors import InputError

ModelT = TypeVar("ModelT", bound=BaseModel)
FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])
#: Interfaces with an option: job, command `graspd synth`, `graspd.synthesize`, file of an asset, limits of a key.
Place = Literal["job", "synth", "python", "asset", "limit"]
EVERYWHERE: Final[tuple[Place, ...]] = ("job", "synth", "python")
JOB: Final[tuple[Place, ...]] = ("job",)
_UNIT: Final = re.compile(r"\[([^\]]+)\]")


@dataclass(frozen=True)
class FormField:
    """Input of an option in a dashboard form."""

    group: Literal["", "Planning", "Grasp", "Object", "Scene", "Validation", "Pictures", "Episodes"]
    """Title of a group of advanced options; empty: the form shows the option first."""
    label: str
    hint: str = ""
    choices: Mapping[str, str] = field(default_factory=dict)
    """Values with their labels; empty: a text field."""
    placeholder: str = ""
    cells: bool = False
    """Whether the form of a dataset also has the option."""


@dataclass(frozen=True)
class Option:
    """Metadata of an option besides type, default, bounds and description."""

    group: Literal["basic", "advanced"] = "advanced"
    places: tuple[Place, ...] = EVERYWHERE
    flags: str = ""
    """Flags on the command line, separated by spaces; empty: `--` and the option's name."""
    typed: str = ""
    """Description for command line and form, if it differs from the description for HTTP."""
    schema: int = 0
    """First schema of task messages with the field; 0: all schemas have it."""


@dataclass(frozen=True)
class OptionRow:
    name: str
    field: FieldInfo
    option: Option

    @property
    def flags(self) -> list[str]:
        return self.option.flags.split() or [f"--{self.name.replace('_', '-')}"]

    @property
    def meaning(self) -> str:
        return self.option.typed or self.field.description or ""

    @property
    def unit(self) -> str:
        found = _UNIT.search(self.meaning)
        return found[1] if found else ""

    @property
    def default(self) -> Any:
        return self.field.get_default(call_default_factory=True)

    @property
    def bounds(self) -> dict[str, float]:
        return bounds_of(self.field)

    @property
    def range(self) -> str:
        """Bounds as a phrase, such as `at least 0 and at most 3`; empty: none."""
        return range_text(self.bounds).removeprefix("must be ")

    @property
    def kind(self) -> Any:
        """Type on a command line or in a form: bool, int, float, str, a Literal of strings, or list[str]."""
        return _value_type(self.field.annotation)


def option_rows(model: type[BaseModel], place: Place) -> list[OptionRow]:
    found = [
        OptionRow(name, one, option)
        for name, one in model.model_fields.items()
        for option in one.metadata
        if isinstance(option, Option) and place in option.places
    ]
    return sorted(found, key=lambda row: row.option.group != "basic")


def validate(model: type[ModelT], values: Mapping[str, Any], *, names: Mapping[str, str] | None = None) -> ModelT:
    """Validate values; InputError reports the first invalid field, with its name in `names` if given."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(first_error(error, model, names)) from None


def with_keywords(model: type[BaseModel], place: Place) -> Callable[[FunctionT], FunctionT]:
    """Decorate a function with a parameter `**options`: its signature shows each option as a keyword."""

    def decorate(function: FunctionT) -> FunctionT:
        signature = inspect.signature(function)
        own = [one for one in signature.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
        options = [
            inspect.Parameter(row.name, inspect.Parameter.KEYWORD_ONLY, default=row.default, annotation=text)
            for row, text in keywords_of(model, place)
        ]
        function.__signature__ = signature.replace(parameters=[*own, *options])  # type: ignore[attr-defined]
        return function

    return decorate


def keywords_of(model: type[BaseModel], place: Place) -> list[tuple[OptionRow, str]]:
    return [(row, type_text(row.field.annotation)) for row in option_rows(model, place)]


def type_text(annotation: Any) -> str:
    """Return an annotation as source text, without bounds; models become mappings."""
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
    if annotation is type(None):
        return "None"
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return "Mapping[str, Any]"
    return "Any" if annotation is Any else str(annotation.__name__)


def _value_type(annotation: Any) -> Any:
    while get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    if get_origin(annotation) in (tuple, dict):
        return list[str]
    members = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    parts = [one for one in members if one is not type(None)]
    if len(parts) == 1 and parts[0] is not annotation:
        return _value_type(parts[0])
    return annotation if annotation in (bool, int, float) or get_origin(annotation) is Literal else str
