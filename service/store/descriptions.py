"""`asset.json` as the front door takes it: a small, flat JSON object. What its keys mean is checked by the worker that
reads the hand or object (`worker.hands.options`, `worker.objects.options`)."""

from __future__ import annotations

from typing import Annotated, Any, Final

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import from_json, to_json

from service.model.errors import InputError
from service.model.refusals import refusal

#: The built-in hands need 2 KB; the facts stand in every list of hands or objects.
MAX_BYTES: Final = 64 << 10
MAX_FACTS_BYTES: Final = 8 << 10
_MAX_DEPTH: Final = 6
_MAX_NUMBER: Final = 2**53
_BOM: Final = b"\xef\xbb\xbf"


def _small(facts: dict[str, Any]) -> dict[str, Any]:
    if len(to_json(facts)) > MAX_FACTS_BYTES:
        raise ValueError(f"the facts take more than {MAX_FACTS_BYTES} bytes; leave some out")
    return facts


class Description(BaseModel):
    """The keys that the service itself reads; the others are kept for the worker."""

    model_config = ConfigDict(extra="allow", frozen=True)

    file: str = Field(min_length=1, max_length=255, description="main file: the URDF or the mesh")
    description: str = Field("", max_length=2000)
    licence: str = Field("", max_length=500)
    source: str = Field("", max_length=2000)
    facts: Annotated[dict[Annotated[str, Field(max_length=100)], Any], AfterValidator(_small)] = Field(
        default_factory=dict
    )


def parse_description(data: bytes, what: str) -> Description:
    """An `asset.json`; InputError, which begins with `what`, if it is none."""
    given = json_object(data, f"{what}: asset.json")
    try:
        return Description.model_validate(given)
    except ValidationError as error:
        raise InputError(f"{what}: asset.json must name the main file and hold short facts: {refusal(error)}") from None


def json_object(text: bytes | str, what: str) -> dict[str, Any]:
    """A JSON object of bounded size and depth from its text; InputError if it is none."""
    data = text.encode(errors="replace") if isinstance(text, str) else text
    if len(data) > MAX_BYTES:
        raise InputError(f"{what} has more than {MAX_BYTES} bytes; leave out what is not needed")
    try:
        value = from_json(data.removeprefix(_BOM), allow_inf_nan=False)
    except ValueError:
        value = None
    if not isinstance(value, dict):
        raise InputError(f'{what} must be a JSON object such as {{"units": "mm"}}')
    if not _is_plain(value, _MAX_DEPTH):
        raise InputError(f"{what} is nested more than {_MAX_DEPTH} deep, or holds a number above 2^53")
    return value


def _is_plain(value: Any, depth: int) -> bool:
    if isinstance(value, dict | list):
        inner = value.values() if isinstance(value, dict) else value
        return depth > 0 and all(_is_plain(part, depth - 1) for part in inner)
    return not isinstance(value, int) or abs(value) <= _MAX_NUMBER
