"""What a client has already (RFC 9110 §13): whether it needs a file again, and whether its half of one still fits."""

from __future__ import annotations

import re
from typing import Final

from starlette.datastructures import Headers

_TAGS: Final = re.compile(r'\s*((?:W/)?"[^"]*")\s*(?:,|$)')


def is_known(headers: Headers, etag: str) -> bool:
    """Whether If-None-Match names this file, so that 304 is the answer.

    Args:
        etag: strong entity tag, with its quotes.
    """
    given = headers.getlist("if-none-match")
    return any(value.strip() == "*" for value in given) or etag in {
        tag.removeprefix("W/") for value in given for tag in _TAGS.findall(value)
    }


def range_applies(headers: Headers, etag: str) -> bool:
    """Whether Range counts: If-Range is absent, or names this very file. Dates name none, for none is ever sent."""
    given = headers.get("if-range")
    return given is None or given.strip() == etag
