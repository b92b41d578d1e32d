"""Command-line options, derived from the option tables of `service.model.options`."""

import functools
import inspect
import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import fields
from typing import Annotated, Any, get_type_hints

import typer
from pydantic import BaseModel

from graspd.service.model.errors import InputError
from graspd.service.model.options import EVERYWHERE, ModelT, OptionRow, Place, option_rows, validate


def with_options(model: type[BaseModel], place: Place) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a command: replace its parameter `options` by one command-line option per row of `model`."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def wrapper(**given: Any) -> None:
            options = {row.name: given.pop(row.name) for row in added}
            command(**given, options={name: value for name, value in options.items() if value is not None})

        added = option_rows(model, place)
        own = list(inspect.signature(command, eval_str=True).parameters.values())
        at = [parameter.name for parameter in own].index("options")
        return set_parameters(wrapper, [*own[:at], *map(_option_parameter, added), *own[at + 1 :]])

    return decorate


def with_fields(model: type[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a command: each annotated field of the dataclass `options` becomes an option."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def wrapper(**given: Any) -> None:
            options = model(**{name: given.pop(name) for name in types})
            command(**given, options=options)

        types = {one.name: (one.default, get_type_hints(model, include_extras=True)[one.name]) for one in fields(model)}
        own = list(inspect.signature(command, eval_str=True).parameters.values())
        at, by_name = [parameter.name for parameter in own].index("options"), inspect.Parameter.KEYWORD_ONLY
        added = [inspect.Parameter(name, by_name, default=one, annotation=kind) for name, (one, kind) in types.items()]
        return set_parameters(wrapper, [*own[:at], *added, *own[at + 1 :]])

    return decorate


def set_parameters(wrapper: Callable[..., None], parameters: Iterable[inspect.Parameter]) -> Callable[..., None]:
    """Return a wrapper of a command with parameters of its own, all by keyword, for the command line."""
    del wrapper.__wrapped__  # type: ignore[attr-defined]  # The signature of the original command differs.
    shown = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]
    wrapper.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
    wrapper.__annotations__ = {parameter.name: parameter.annotation for parameter in shown}
    return wrapper


def _option_parameter(row: OptionRow) -> inspect.Parameter:
    text = row.meaning[:1].upper() + row.meaning[1:]
    if row.kind == list[str]:
        text += "; repeatable"
    elif row.default not in (None, "") and row.kind is not bool:
        text += f". Default: {row.default}"
    least, most = (row.bounds.get(key) if row.kind in (int, float) else None for key in ("ge", "le"))
    option = typer.Option(*row.flags, help=f"{text}.", show_default=False, min=least, max=most)
    annotation: Any = Annotated[row.kind | None, option]
    return inspect.Parameter(row.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def validate_options(model: type[ModelT], values: dict[str, Any]) -> ModelT:
    """Validate the given options; InputError names the first invalid one as on the command line."""
    options = {row.name: row.flags[0].partition("/")[0] for place in EVERYWHERE for row in option_rows(model, place)}
    names = {name: f"--{name.replace('_', '-')}" for name in model.model_fields}
    # The name of a dataset is an argument, not an option.
    return validate(model, values, names={**names, "name": "NAME", **options})


def parse_pairs(texts: Iterable[str]) -> dict[str, str | int | float]:
    """Parse the `name=value` of each `--option`; numeric values become numbers, as in a request's JSON."""
    split = [text.partition("=") for text in texts]
    for name, equals, value in split:
        if not equals:
            raise InputError(f"--option {name + value!r}: write it as name=value, for example steps=20000")
    return {name: _parse_number(value) for name, _, value in split}


def _parse_number(text: str) -> str | int | float:
    for kind in (int, float):
        with suppress(ValueError):
            number = kind(text)
            # Only canonical numbers are converted: 007 and nan stay text.
            return number if str(number) == text and math.isfinite(number) else text
    return text
