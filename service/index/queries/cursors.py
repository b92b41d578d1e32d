"""Opaque keyset cursors: the sort key of the last row of a page, so that a page costs the same wherever it starts."""

from __future__ import annotations

import base64
import json
from typing import Any, Final

from pydantic_core import from_json

from service.model.errors import InputError

MAX_LIMIT: Final = 200
#: Every database holds whole numbers up to here.
_MOST: Final = 2**63


def encode(*key: Any) -> str:
    """Text of a sort key, safe in a URL."""
    return base64.urlsafe_b64encode(json.dumps(key, separators=(",", ":")).encode()).decode().rstrip("=")


def decode(cursor: str, *kinds: type | tuple[type, ...]) -> tuple[Any, ...]:
    """The sort key of a cursor, checked against the types of its parts; InputError if it is none of ours."""
    try:
        key = from_json(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)), allow_inf_nan=False)
    except ValueError:
        raise InputError("the cursor is not one that this list gave out; start without it") from None
    if not isinstance(key, list) or len(key) != len(kinds) or not all(map(isinstance, key, kinds)):
        raise InputError("the cursor belongs to another list or another order; start without it")
    if any(isinstance(part, int) and not -_MOST <= part < _MOST for part in key):
        raise InputError("the cursor is not one that this list gave out; start without it")
    return tuple(key)


def page_size(limit: int) -> int:
    """A limit between 1 and `MAX_LIMIT`."""
    if limit < 1:
        raise InputError("the limit must be at least 1")
    return min(limit, MAX_LIMIT)
