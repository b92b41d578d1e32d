"""The middleware that keeps foreign web pages out."""

from __future__ import annotations

from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from api.hosts import host_name
from api.problems import ApiError, answer

SAFE_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})


class SameOrigin:
    """Refuses what a foreign web page could make a visitor's browser do.

    A browser names the page a request comes from (Sec-Fetch-Site, Origin); other clients send neither. While no keys
    exist the service answers only to names of this machine, so that a rebound DNS name reaches nothing.

    Args:
        allowed_hosts: host names the service answers to; None: any.
    """

    def __init__(self, app: ASGIApp, *, allowed_hosts: frozenset[str] | None) -> None:
        self.app = app
        self.allowed_hosts = allowed_hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and (error := self._refusal(scope)) is not None:
            await answer(Request(scope), error)(scope, receive, send)
            return
        await self.app(scope, receive, send)

    def _refusal(self, scope: Scope) -> ApiError | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if self.allowed_hosts is not None and host_name(host) not in self.allowed_hosts:
            return ApiError(421, f"this service does not answer to the name {host_name(host)!r}; use 127.0.0.1")
        if scope["method"] in SAFE_METHODS:
            return None
        site = headers.get("sec-fetch-site")
        origin = headers.get("origin")
        if site not in (None, "same-origin", "none"):
            return ApiError(403, "the request comes from another web site; open the dashboard itself and try again")
        if origin is not None and _place(origin) != host:
            return ApiError(403, f"the request comes from {origin}; open the dashboard itself and try again")
        return None


def _place(origin: str) -> str | None:
    """Host and port of an origin; None where it is no address at all."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None
