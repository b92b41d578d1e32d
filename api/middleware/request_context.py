"""What stands before every route: request ids, security headers, and the checks that keep foreign web pages out."""

from __future__ import annotations

import logging
import re
import time
import uuid
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.metrics import Metrics
from api.middleware.same_origin import SAFE_METHODS
from api.problems import answer, log_unforeseen
from service import tracing
from service.logs import bind
from service.model.errors import GraspdError

_access = logging.getLogger("graspd.access")
#: Asked every few seconds by whatever watches the service.
_QUIET: Final = ("/static/", "/healthz", "/readyz", "/metrics")


_METHODS: Final = SAFE_METHODS | {"POST", "PUT", "PATCH", "DELETE"}
_REQUEST_ID: Final = re.compile(r"[A-Za-z0-9._-]{1,64}")

CONTENT_SECURITY_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; font-src 'self'; "
    "connect-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
)

_SECURITY_HEADERS: Final = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}


class RequestContext:
    """Outermost: gives the request its id, times it, and turns an unforeseen exception into a problem document."""

    def __init__(self, app: ASGIApp, *, metrics: Metrics) -> None:
        self.app = app
        self.metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request_id = _request_id(Headers(scope=scope).get("x-request-id"))
        scope.setdefault("state", {})["request_id"] = request_id
        parent = Headers(scope=scope).get("traceparent", "")
        with tracing.span(f"HTTP {_method(scope)}", parent=parent, request=request_id) as facts:
            with bind(request=request_id, traceparent=tracing.traceparent()):
                await self._answer(scope, receive, send, request_id)
            facts["http.route"] = _route(scope)

    async def _answer(self, scope: Scope, receive: Receive, send: Send, request_id: str) -> None:
        started = time.perf_counter()
        status = 0

        async def with_headers(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-Id"] = request_id
                for name, value in _SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
                if scope["scheme"] == "https":
                    headers.setdefault("Strict-Transport-Security", "max-age=31536000")
                if scope["path"].startswith("/v1/"):
                    headers.setdefault("Cache-Control", "no-store")
            await send(message)

        try:
            await self.app(scope, receive, with_headers)
        except Exception as error:
            if not isinstance(error, GraspdError):
                log_unforeseen(scope["path"], request_id, error)
            if status:
                raise
            answered = getattr(scope["app"].state, "answer_error", answer) if "app" in scope else answer
            await answered(Request(scope), error)(scope, receive, with_headers)
        finally:
            self._note(scope, status, time.perf_counter() - started)

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        """Count the answer and write its line."""
        route = _route(scope)
        self.metrics.observe(_method(scope), route, status, seconds)
        level = logging.DEBUG if scope["path"].startswith(_QUIET) else logging.INFO
        key = scope["state"].get("key")
        about = {"status": status, "ms": round(1000 * seconds, 1), "route": route, "key": key.name if key else ""}
        about["client"] = scope["client"][0] if scope.get("client") else ""
        _access.log(level, "%s %s %d", _method(scope), scope["path"], status, extra=about)


def _method(scope: Scope) -> str:
    """Clients may write any word for the method; only those that HTTP knows become names of series."""
    return scope["method"] if scope["method"] in _METHODS else "other"


def _route(scope: Scope) -> str:
    return getattr(scope.get("route"), "path", "unmatched")


def _request_id(given: str | None) -> str:
    return given if given and _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex[:16]
