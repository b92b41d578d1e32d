"""Base class of the domain models, patterns of names, and texts of validation errors."""

import math
import re
from collections.abc import Mapping
from typing import Annotated, Any, Final, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError
from pydantic.fields import FieldInfo

from graspd.service.model.errors import choices_text


class Model(BaseModel):
    """Base class of domain models: frozen; unknown fields are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid")


#: Name given by a user. Letters, digits, dot, dash and underscore only, because file names and URLs contain it.
NAME: Final = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
Name = Annotated[str, Field(pattern=NAME)]
#: Name of a tag: words of the characters of `Name`, separated by single spaces.
TagName = Annotated[
    str,
    StringConstraints(strip_whitespace=True, max_length=64, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*( [A-Za-z0-9._-]+)*$"),
]
DIGEST: Final = r"^[0-9a-f]{32}$"
Digest = Annotated[str, Field(pattern=DIGEST)]
#: An id or an empty text. Any client can write to Redis, so this pattern limits values from Redis.
Word = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{0,64}$")]

_WORDS: Final = {
    "missing": "is missing",
    "extra_forbidden": "is not known",
    "greater_than_equal": "must be at least {ge}",
    "less_than_equal": "must be at most {le}",
    "greater_than": "must be more than {gt}",
    "less_than": "must be less than {lt}",
    "string_pattern_mismatch": "must match {pattern}",
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "must be a whole number"),
    **dict.fromkeys(("float_type", "float_parsing"), "must be a number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "must be true or false"),
}
#: Pydantic's error types for bounds, with the name of each bound.
_BOUNDS: Final = {"greater_than_equal": "ge", "greater_than": "gt", "less_than_equal": "le", "less_than": "lt"}
_NAMES: Final = "must begin with a letter or digit and have at most 64 letters, digits, dots, dashes and underscores"
#: Prefixes of pydantic's messages that `problem_text` removes or replaces by `must`.
_SUBJECT: Final = re.compile(r"^(Value error, )|^\w+ should ")
_CLASS: Final = re.compile(r"_[A-Z]\w*$|constrained-\w+$")
#: Typer's message about choices; pydantic's key for choices is `expected`.
_CHOICES: Final = re.compile(r"'(?P<word>.*?)' is not one of (?P<expected>'.*')")


def first_error(
    error: ValidationError, model: type[BaseModel] | None = None, names: Mapping[str, str] | None = None
) -> str:
    """Return the text of the first error, such as `scene.touch: must be at least -1`.

    `model` adds all bounds of the field; `names` maps fields to names for the user.
    """
    first = error.errors(include_url=False)[0]
    # For a union of models, pydantic adds the name of the tested model.
    place = [str(part) for part in first["loc"] if not _CLASS.match(str(part))]
    if place and names:
        name = names.get(place[0], place[0])
        place = [name] if name.startswith("-") else [name, *place[1:]]
    field = model.model_fields.get(str(first["loc"][0])) if model and len(first["loc"]) == 1 else None
    is_bounded = field and first["type"] in _BOUNDS
    text = f"{range_text(bounds_of(field))}; got {first['input']!r}" if field and is_bounded else problem_text(first)
    return f"{'.'.join(place)}: {text}" if place else text


def bounds_of(field: FieldInfo) -> dict[str, float]:
    """Return the bounds of a number, optional or not, by their names in pydantic: ge, gt, le, lt."""
    found: dict[str, float] = {}
    for one in [*(part for kind in get_args(field.annotation) for part in _annotation_metadata(kind)), *field.metadata]:
        found |= {key: value for key in _BOUNDS.values() if (value := getattr(one, key, None)) is not None}
    return found


def _annotation_metadata(annotation: object) -> list[object]:
    inner = get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()
    return [part for one in inner for part in (one.metadata if isinstance(one, FieldInfo) else (one,))]


def range_text(bounds: Mapping[str, float]) -> str:
    texts = [_WORDS[name].format(**{key: f"{bounds[key]:.12g}"}) for name, key in _BOUNDS.items() if key in bounds]
    return " and ".join([*texts[:1], *(text.removeprefix("must be ") for text in texts[1:])])


def problem_text(entry: Mapping[str, Any]) -> str:
    facts = entry.get("ctx", {})
    message = _SUBJECT.sub(lambda found: "" if found[1] else "must ", entry["msg"])
    if facts.get("pattern") == NAME:
        return _NAMES
    choices = _CHOICES.match(message)
    if "expected" in facts or choices:
        expected = choices["expected"] if choices else facts["expected"]
        known = re.findall(r"'([^']*)'", expected)
        word = choices["word"] if choices else entry.get("input")
        return f"must be one of {choices_text(str(word), known)}" if known else message
    template = _WORDS.get(entry["type"])
    bounds = {name: f"{value:g}" if isinstance(value, float) else value for name, value in facts.items()}
    return template.format(**bounds) if template else message


def first_line(error: BaseException) -> str:
    """Return the first line of a library's error message, or the name of the error."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def error_text(error: Exception) -> str:
    """Return a library's error message; for a system error, without its number and path."""
    return getattr(error, "strerror", None) or str(error)


def json_value(value: Any) -> Any:
    """Return a nested value for JSON: None replaces nan and infinity."""
    if isinstance(value, dict):
        return {str(key): json_value(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
