"""Who asks: the key that a request shows, by header or by the cookie of a browser, or whom a proxy has signed in; and
what they may do.

The service is open while no key was ever made and it binds to this machine only. Once there is a key it stays closed,
also when the last one is revoked or expired.
"""

from __future__ import annotations

import ipaddress
from contextvars import ContextVar
from typing import Final

from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.types import Scope as AsgiScope

from api.access.keys import Key, KeyFile, Scope
from api.access.proxy import Proxy
from api.problems import ApiError
from service.model.projects import EVERYTHING, ProjectScope

SESSION_COOKIE: Final = "graspd_session"
#: Headers that a proxy adds: while the service is open they mean that somebody else's requests arrive here.
_OF_PROXIES: Final = ("x-forwarded-for", "x-forwarded-host", "forwarded", "via", "x-real-ip")

#: Key of the request that is being answered; None while the service is open.
caller: ContextVar[Key | None] = ContextVar("caller", default=None)


def caller_id() -> str:
    """Id of the caller's key; empty while the service is open."""
    key = caller.get()
    return key.id if key else ""


def project_scope() -> ProjectScope:
    """What the key of the present request may see: its project; with `admin`, and while the service is open, all."""
    key = caller.get()
    return EVERYTHING if key is None else ProjectScope(key.project, everything=key.scope.includes(Scope.ADMIN))


class NotYours(ApiError):
    """A thing that another key submitted."""


def authorize(request: HTTPConnection, scope: Scope) -> Key | None:
    """The key of a request; None while the service is open.

    Raises:
        ApiError: 401 without a live key, 403 with one of a smaller scope.
    """
    keys: KeyFile = request.app.state.keys
    if keys.is_open:
        refuse_strangers(request)
        return None
    key: Key | None = request.scope.get("state", {}).get("key")
    if key is None:
        raise ApiError(
            401,
            "a live key is needed: send `Authorization: Bearer gd_...`; `graspd keys add` makes one",
            headers={"WWW-Authenticate": 'Bearer realm="graspd"'},
        )
    if not key.scope.includes(scope):
        raise ApiError(403, f"the key {key.name!r} has scope {key.scope}; this needs {scope}")
    return key


def may_still(request: HTTPConnection, scope: Scope) -> bool:
    """Whether a long answer may go on: its key may have been revoked, or have expired, since the request came."""
    keys: KeyFile = request.app.state.keys
    if keys.is_open:
        return True
    key = identify(request.scope, keys, request.app.state.proxy)
    return key is not None and key.scope.includes(scope)


def may_change(owner: str, project: str = "") -> bool:
    """Whether the key of the present request may cancel, retry or delete a thing: its own or its project's, or with
    `admin` any.

    Args:
        owner: id of the key that the thing was submitted with; empty where it was submitted without one, or before
            ids were recorded: then it takes `admin`.
        project: what the thing belongs to. Keys of a project act for each other; those of none, for themselves.
    """
    key = caller.get()
    if key is None or key.scope.includes(Scope.ADMIN):
        return True
    is_theirs = key.project == project if project else key.id == owner
    return key.scope.includes(Scope.SUBMIT) and is_theirs


def must_own(owner: str, what: str, project: str = "") -> None:
    """Refuse to change somebody else's thing. The route has asked for `submit` before.

    Args:
        owner, project: as in `may_change`.
        what: names the thing in the refusal, such as "job 1a2b".

    Raises:
        NotYours: it is not the caller's, and the key is no `admin` key.
    """
    if not may_change(owner, project):
        key = caller.get()
        assert key is not None
        raise NotYours(
            403,
            f"{what} was not submitted with the key {key.name!r}; the key that submitted it can do this, or one with "
            "scope admin",
        )


def is_allowed(request: HTTPConnection, scope: Scope) -> bool:
    """Whether `authorize` would let the request pass."""
    try:
        authorize(request, scope)
    except ApiError:
        return False
    return True


def refuse_strangers(request: HTTPConnection) -> None:
    """While the service is open, only this machine may use it.

    Raises:
        ApiError: 403, the request comes from elsewhere, or through a proxy that may serve anybody.
    """
    passed_on = next((name for name in _OF_PROXIES if name in request.headers), None)
    address = request.client.host if request.client else ""
    if passed_on is None and not _is_elsewhere(address):
        return
    by = f"through a proxy (header {passed_on})" if passed_on else f"from {address}"
    raise ApiError(
        403,
        f"this service has no keys and answers to its own machine only; the request came {by}; "
        "make a key with `graspd keys add NAME --scope admin`",
    )


def identify(scope: AsgiScope, keys: KeyFile, proxy: Proxy) -> Key | None:
    """The live key that a header or a session cookie names, or the person that the proxy vouches for."""
    scheme, _, token = Headers(scope=scope).get("authorization", "").partition(" ")
    if scheme.lower() == "bearer" and token:
        return keys.find(token.strip())
    if person := proxy.find(scope):
        return person
    cookie = HTTPConnection(scope).cookies.get(SESSION_COOKIE)
    return keys.find_session(cookie) if cookie else None


def _is_elsewhere(address: str) -> bool:
    try:
        return not ipaddress.ip_address(address).is_loopback
    except ValueError:
        # A unix socket has no address, a test client has a made-up one.
        return False
