"""Middleware of all routes: request ids, security headers, HEAD (RFC 9110 §9.3.2), prefix, origin.

The application's paths have no prefix. `RootPath` removes the prefix from paths of requests, unless the proxy already
did, and adds it to response headers; rendering adds it to addresses in pages (`add_prefix`).
"""

import logging
import re
import time
import uuid
from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.routing import Match
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from graspd.api.metrics import Metrics
from graspd.api.problems import ApiError, error_response
from graspd.service.model.errors import GraspdError
from graspd.service.telemetry import bind_subjects

_access = logging.getLogger("graspd.access")
_log = logging.getLogger("graspd.api")
_QUIET: Final = ("/static/", "/healthz", "/readyz", "/metrics")

SAFE_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})

_METHODS: Final = SAFE_METHODS | {"POST", "PUT", "PATCH", "DELETE"}
_REQUEST_ID: Final = re.compile(r"[A-Za-z0-9._-]{1,64}")

_SECURITY_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "media-src 'self'; font-src 'self'; connect-src 'self'; "
    "form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}


class HttpMiddleware:
    """Middleware of HTTP requests; lifespan events of the application pass unchanged."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await (self.handle if scope["type"] == "http" else self.app)(scope, receive, send)

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        raise NotImplementedError


class RequestContext(HttpMiddleware):
    """Sets the request id, times the request, and reports unexpected errors as problem documents."""

    def __init__(self, app: ASGIApp, *, metrics: Metrics) -> None:
        super().__init__(app)
        self.metrics = metrics

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        given = Headers(scope=scope).get("x-request-id", "")
        request_id = given if _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex[:16]
        scope.setdefault("state", {})["request_id"] = request_id
        with bind_subjects(request=request_id):
            await self._handle_request(scope, receive, send, request_id)

    async def _handle_request(self, scope: Scope, receive: Receive, send: Send, request_id: str) -> None:
        started, status = time.perf_counter(), 0

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
                _log.error("request %s on %s failed", request_id, scope["path"], exc_info=error)
            if status:
                raise
            await scope["app"].state.answer_error(Request(scope), error)(scope, receive, with_headers)
        finally:
            self._record_request(scope, status, time.perf_counter() - started)

    def _record_request(self, scope: Scope, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", "unmatched")
        self.metrics.observe(_method(scope), route, status, seconds)
        level = logging.DEBUG if scope["path"].startswith(_QUIET) else logging.INFO
        key = scope["state"].get("key")
        about = {"status": status, "ms": round(1000 * seconds, 1), "route": route, "key": key.name if key else ""}
        about["client"] = scope["client"][0] if scope.get("client") else ""
        _access.log(level, "%s %s %d", _method(scope), scope["path"], status, extra=about)


def _method(scope: Scope) -> str:
    """Return the method if HTTP defines it, else "other": arbitrary words must not become labels."""
    return scope["method"] if scope["method"] in _METHODS else "other"


class HeadMethod(HttpMiddleware):
    """Answers HEAD like GET without the body, unless a route has its own HEAD."""

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        routes = scope["app"].routes
        if scope["method"] != "HEAD" or any(route.matches(dict(scope))[0] is Match.FULL for route in routes):
            await self.app(scope, receive, send)
            return

        is_over = False

        async def without_body(message: Message) -> None:
            nonlocal is_over
            if message["type"] == "http.response.start":
                await send(message)
                # A response without a length may be endless, so it ends now; others continue and close their files.
                is_last = all(name.lower() != b"content-length" for name, _ in message["headers"])
            else:
                is_last = not message.get("more_body", False)
            if is_last and not is_over:
                is_over = True
                await send({"type": "http.response.body", "body": b"", "more_body": False})

        headers = scope["headers"]
        scope["method"], scope["headers"] = "GET", [one for one in headers if one[0] != b"range"]
        try:
            await self.app(scope, receive, without_body)
        finally:
            scope["method"], scope["headers"] = "HEAD", headers


#: HTML attributes whose value is an address on this host; quotes in texts from users are escaped.
_ADDRESS: Final = re.compile(r'(?<=\s)((?:href|src|action|formaction|hx-[a-z-]+|data-[a-z-]+)=")(?=/(?!/))')
_COOKIE_PATH: Final = re.compile(r";\s*Path=/(?=;|$)", re.IGNORECASE)


class RootPath(HttpMiddleware):
    """Removes a prefix such as `/graspd` from paths and adds it to `Location` and to cookie paths."""

    def __init__(self, app: ASGIApp, *, prefix: str) -> None:
        super().__init__(app)
        self.prefix = prefix

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["path"] == self.prefix or scope["path"].startswith(f"{self.prefix}/"):
            scope = {**scope, "path": scope["path"].removeprefix(self.prefix) or "/"}
            if raw := scope.get("raw_path"):
                scope["raw_path"] = raw.removeprefix(self.prefix.encode()) or b"/"
        host = Headers(scope=scope).get("host", "")

        async def add_prefix_to_location(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if (where := headers.get("location")) is not None:
                    headers["location"] = self._add_prefix(where, host)
                if cookies := headers.getlist("set-cookie"):
                    del headers["set-cookie"]
                    for cookie in cookies:
                        headers.append("set-cookie", _COOKIE_PATH.sub(f"; Path={self.prefix}", cookie))
            await send(message)

        await self.app(scope, receive, add_prefix_to_location)

    def _add_prefix(self, where: str, host: str) -> str:
        parts = urlsplit(where)
        if parts.netloc not in ("", host) or not parts.path.startswith("/"):
            return where  # Such as a signed address of the store.
        return parts._replace(path=f"{self.prefix}{parts.path}").geturl()


def add_prefix(page: str, prefix: str) -> str:
    """Add the prefix to a page's addresses on this host."""
    return _ADDRESS.sub(rf"\g<1>{prefix}", page) if prefix else page


class SameOrigin(HttpMiddleware):
    """Refuses requests that a page of another site triggers in a visitor's browser.

    While no keys exist, the host must be a name of this machine, to prevent DNS rebinding.
    """

    def __init__(self, app: ASGIApp, *, allowed_hosts: frozenset[str] | None) -> None:
        super().__init__(app)
        self.allowed_hosts = allowed_hosts

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        error = self._refusal(scope)
        await (error_response(Request(scope), error) if error else self.app)(scope, receive, send)

    def _refusal(self, scope: Scope) -> ApiError | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if self.allowed_hosts is not None and host_name(host) not in self.allowed_hosts:
            return ApiError(421, f"this service does not accept the host name {host_name(host)!r}; use 127.0.0.1")
        if scope["method"] in SAFE_METHODS:
            return None
        site, origin = headers.get("sec-fetch-site"), headers.get("origin")
        if site not in (None, "same-origin", "none"):
            return ApiError(403, "the request comes from another web site; open the dashboard itself and try again")
        if origin is not None and _host_of_origin(origin) != host:
            return ApiError(403, f"the request comes from {origin}; open the dashboard itself and try again")
        return None


def _host_of_origin(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None


def host_name(host: str) -> str:
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.rpartition(":")[0] if host.count(":") == 1 else host
