"""Authentication of a request by key, session cookie or proxy; permissions of the caller.

Before the first key, only requests from this machine are answered. Afterwards requests need a key, even if all keys are
revoked or expired. A proxy may authenticate people (OIDC). It sends their groups in X-Forwarded-Groups, and
`Authorization: Basic user:secret` (option `--basic-auth-password` of oauth2-proxy). Any client can send such headers:
the connection's address and the secret must be the proxy's, and no header may be duplicate.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import ipaddress
import re
from collections.abc import Callable
from contextvars import ContextVar
from functools import partial
from typing import Any, Final, Generic, ParamSpec, TypeVar

from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.types import Scope as AsgiScope

from graspd.api.access.keys import Key, KeyFile, Scope
from graspd.api.problems import ApiError
from graspd.service.index.index import Index
from graspd.service.model.errors import InputError
from graspd.service.model.projects import EVERYTHING, PATTERN, ProjectScope
from graspd.service.settings import Settings

P = ParamSpec("P")
T = TypeVar("T")
SESSION_COOKIE: Final = "graspd_session"
#: Headers that proxies add; they reveal that a request may come from another machine.
_OF_PROXIES: Final = ("x-forwarded-for", "x-forwarded-host", "forwarded", "via", "x-real-ip")

caller: ContextVar[Key | None] = ContextVar("caller", default=None)


def caller_id() -> str:
    key = caller.get()
    return key.id if key else ""


def project_scope() -> ProjectScope:
    """Return the projects that the caller sees: its own; all for `admin`, and while there are no keys."""
    key = caller.get()
    return EVERYTHING if key is None else ProjectScope(key.project, everything=key.scope.includes(Scope.ADMIN))


class InScope(Generic[P, T]):
    """Method of a class with `_services`: a query of the index, limited to the caller's scope."""

    def __init__(self, query: Callable[[Index], Callable[P, T]]) -> None:
        self._query = query

    def __get__(self, catalog: Any, kind: type) -> Callable[P, T]:
        return partial(self._query(catalog._services.index), scope=project_scope())  # type: ignore[arg-type]


class ForeignResource(ApiError):
    """Refusal to change a resource of another project or key."""


def authorize(request: HTTPConnection, scope: Scope) -> Key | None:
    """Return the key of a request, or None while no key is needed; raise ApiError 401 or 403."""
    keys: KeyFile = request.app.state.keys
    if keys.is_open:
        _require_local_request(request)
        return None
    key: Key | None = request.scope.get("state", {}).get("key")
    if key is None:
        problem = "a valid key is needed: send `Authorization: Bearer gd_...`; `graspd keys add` makes one"
        raise ApiError(401, problem, headers={"WWW-Authenticate": 'Bearer realm="graspd"'})
    if not key.scope.includes(scope):
        raise ApiError(403, f"the key {key.name!r} has scope {key.scope}; this needs {scope}")
    return key


def is_still_authorized(request: HTTPConnection, scope: Scope) -> bool:
    """Check whether a long response may continue; its key may have expired or been revoked meanwhile."""
    keys: KeyFile = request.app.state.keys
    if keys.is_open:
        return True
    key = authenticate(request.scope, keys, request.app.state.proxy)
    return key is not None and key.scope.includes(scope)


def may_change(owner: str, project: str = "") -> bool:
    """Check whether the caller may change a resource; one without owner and project needs `admin`."""
    key = caller.get()
    if key is None or key.scope.includes(Scope.ADMIN):
        return True
    is_theirs = key.project == project if project else key.id == owner
    return key.scope.includes(Scope.SUBMIT) and is_theirs


def require_ownership(owner: str, what: str, project: str = "") -> None:
    """Raise ForeignResource unless the key may change `what`, such as `job 1a2b`."""
    if not may_change(owner, project):
        key = caller.get()
        assert key is not None
        fix = "use a key of its project (without a project: the key that submitted it), or a key with scope admin"
        raise ForeignResource(403, f"{what} does not belong to the key {key.name!r}; {fix}")


def is_allowed(request: HTTPConnection, scope: Scope) -> bool:
    try:
        authorize(request, scope)
    except ApiError:
        return False
    return True


def _require_local_request(request: HTTPConnection) -> None:
    """Refuse requests from other machines, and from proxies, because these may forward any request."""
    header = next((name for name in _OF_PROXIES if name in request.headers), None)
    address = request.client.host if request.client else ""
    if header or _is_remote(address):
        origin = f"through a proxy (header {header})" if header else f"from {address}"
        problem = f"this service has no keys, so it answers only its own machine; this request came {origin}"
        raise ApiError(403, f"{problem}; make a key with `graspd keys add NAME --scope admin`")


def authenticate(scope: AsgiScope, keys: KeyFile, proxy: Proxy) -> Key | None:
    """Return the key of a request: by its Bearer token, by the proxy, or by its session cookie."""
    scheme, _, token = Headers(scope=scope).get("authorization", "").partition(" ")
    if scheme.lower() == "bearer" and token:
        return keys.find(token.strip())
    if key := proxy.find(scope):
        return key
    cookie = HTTPConnection(scope).cookies.get(SESSION_COOKIE)
    return keys.find_session(cookie) if cookie else None


def _is_remote(address: str) -> bool:
    try:
        return not ipaddress.ip_address(address).is_loopback
    except ValueError:
        # A unix socket has no address; a test client has a fictitious one.
        return False


GROUPS: Final = "x-forwarded-groups"
ANYBODY: Final = "*"
_LEAST_SECRET: Final = 16
_LONGEST_USER: Final = 200
_USER: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@+-]*")


class Proxy:
    """Authenticating proxy from the settings, if any; InputError if they are incomplete or invalid."""

    def __init__(self, settings: Settings) -> None:
        secret = settings.proxy_secret.get_secret_value() if settings.proxy_secret else ""
        if bool(secret) != bool(settings.proxy_addresses):
            raise InputError("set both GRASPD_PROXY_ADDRESSES and GRASPD_PROXY_SECRET, or neither")
        if secret and len(secret) < _LEAST_SECRET:
            raise InputError(f"GRASPD_PROXY_SECRET is shorter than {_LEAST_SECRET} characters; take a random one")
        self._secret = secret.encode()
        self._networks = [_parse_network(one) for one in (settings.proxy_addresses or "").replace(",", " ").split()]
        self._groups = {group: _parse_group(group, said) for group, said in settings.proxy_groups.items()}

    @property
    def is_on(self) -> bool:
        """Whether a proxy authenticates people; requests then need its credentials or a key."""
        return bool(self._secret)

    def find(self, scope: AsgiScope) -> Key | None:
        """Return a key with the rights of the person's group that is first in the settings, or None."""
        if not self.is_on or not self._is_from_proxy(scope):
            return None
        headers = Headers(scope=scope)
        given, groups = headers.getlist("authorization"), headers.getlist(GROUPS)
        if len(given) != 1 or len(groups) > 1 or not (user := self._user(given[0])):
            return None
        theirs = {group.strip() for group in (groups[0] if groups else "").split(",")} | {ANYBODY}
        rights = next((rights for group, rights in self._groups.items() if group in theirs), None)
        return None if rights is None else _proxy_user_key(user, *rights)

    def _is_from_proxy(self, scope: AsgiScope) -> bool:
        try:
            address = ipaddress.ip_address(scope["client"][0])
        except (TypeError, KeyError, ValueError):
            return False
        mapped = getattr(address, "ipv4_mapped", None)
        return any((mapped or address) in network for network in self._networks)

    def _user(self, authorization: str) -> str:
        """Return the user of Basic credentials (RFC 7617) with the proxy's secret; empty for all others."""
        scheme, _, credentials = authorization.partition(" ")
        try:
            user, _, secret = base64.b64decode(credentials.strip(), validate=True).partition(b":")
        except ValueError:
            return ""
        if scheme.lower() != "basic" or not hmac.compare_digest(secret, self._secret):
            return ""
        name = user.decode(errors="replace").lower()
        return name if len(name) <= _LONGEST_USER and _USER.fullmatch(name) else ""


def _proxy_user_key(user: str, project: str, scope: Scope) -> Key:
    digest = hashlib.sha256(f"proxy {user}".encode()).hexdigest()
    # Names of stored keys contain no @, so that people and keys have separate counters.
    name = user[:48] if "@" in user else f"{user[:48]}@proxy"
    return Key(id=digest[:16], name=name, scope=scope, project=project, sha256=digest, created="")


def _parse_network(text: str) -> ipaddress.IPv4Network | ipaddress.IPv6Network:
    try:
        return ipaddress.ip_network(text)
    except ValueError:
        raise InputError(f"GRASPD_PROXY_ADDRESSES: {text!r} is not an address; write 10.0.0.5 or 10.0.0.0/24") from None


def _parse_group(group: str, said: str) -> tuple[str, Scope]:
    project, _, scope = said.partition(":")
    if (project and not re.fullmatch(PATTERN, project)) or scope not in set(Scope):
        fix = "write vision:submit, or :admin"
        raise InputError(f"GRASPD_PROXY_GROUPS: {said!r} of {group!r} is not PROJECT:SCOPE; {fix}")
    return project, Scope(scope)
