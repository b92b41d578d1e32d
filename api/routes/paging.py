"""Links between the pages of a list."""

from __future__ import annotations

from fastapi import Request, Response


def link_next(request: Request, response: Response, cursor: str | None) -> None:
    """Name the next page in the Link header (RFC 8288), with the filters of this one."""
    if cursor is not None:
        response.headers["Link"] = f'<{next_address(request, cursor)}>; rel="next"'


def next_address(request: Request, cursor: str) -> str:
    """Path and query of the page behind a cursor."""
    url = request.url.include_query_params(cursor=cursor)
    return f"{url.path}?{url.query}"
