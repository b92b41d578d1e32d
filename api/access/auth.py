"""Authentication of a request: a key in a header, the cookie of a browser session, or a proxy that signed a person in;
and what the caller may do.

The service is open while no key was ever made and it binds to this machine only. Once there is a key it stays closed,
also when the last one is revoked or expired.

Who asks, where a proxy in front has signed people in (OIDC): believed only from its address and with its secret.

The proxy sends `Authorization: Basic user:secret`, which oauth2-proxy makes of `--basic-auth-password`, and the groups
of the person in X-Forwarded-Groups. Anybody may write such headers; so both the address of the connection and the
secret must be the proxy's, and headers that came twice are refused.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import ipaddress
import re
from contextvars import ContextVar
from typing import Final

from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.types import Scope as AsgiScope

from graspd.api.access.keys import Key, KeyFile, Scope
from graspd.api.problems import ApiError
from graspd.service.model.errors import InputError
from graspd.service.model.projects import EVERYTHING, PATTERN, ProjectScope
from graspd.service.settings import Settings

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


class ForeignResource(ApiError):
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
        raise ForeignResource(
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


GROUPS: Final = "x-forwarded-groups"
#: In the place of a group: whoever is signed in.
ANYBODY: Final = "*"
_LEAST_SECRET: Final = 16
_LONGEST_USER: Final = 200
_USER: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@+-]*")


class Proxy:
    """The proxy that the settings name, if any.

    Raises:
        InputError: only one of addresses and secret is set, the secret is short, or an address or a group cannot be
            read.
    """

    def __init__(self, settings: Settings) -> None:
        secret = settings.proxy_secret.get_secret_value() if settings.proxy_secret else ""
        if bool(secret) != bool(settings.proxy_addresses):
            raise InputError("GRASPD_PROXY_ADDRESSES and GRASPD_PROXY_SECRET are set both or not at all")
        if secret and len(secret) < _LEAST_SECRET:
            raise InputError(f"GRASPD_PROXY_SECRET is shorter than {_LEAST_SECRET} characters; take a random one")
        self._secret = secret.encode()
        self._networks = [_network(one) for one in (settings.proxy_addresses or "").replace(",", " ").split()]
        self._groups = {group: _rights(group, said) for group, said in settings.proxy_groups.items()}

    @property
    def is_on(self) -> bool:
        """Whether people come through a proxy: then the service is closed to everybody without a key."""
        return bool(self._secret)

    def find(self, scope: AsgiScope) -> Key | None:
        """The person that the proxy vouches for, as a key with the rights of the first of their groups in the
        settings; None where nobody is vouched for, or no group of theirs has any rights."""
        if not self.is_on or not self._is_from_proxy(scope):
            return None
        headers = Headers(scope=scope)
        given, groups = headers.getlist("authorization"), headers.getlist(GROUPS)
        if len(given) != 1 or len(groups) > 1:
            return None
        user = self._user(given[0])
        if not user:
            return None
        theirs = {group.strip() for group in (groups[0] if groups else "").split(",")} | {ANYBODY}
        rights = next((rights for group, rights in self._groups.items() if group in theirs), None)
        return None if rights is None else _key_of(user, *rights)

    def _is_from_proxy(self, scope: AsgiScope) -> bool:
        try:
            address = ipaddress.ip_address(scope["client"][0])
        except (TypeError, KeyError, ValueError):
            return False
        mapped = getattr(address, "ipv4_mapped", None)
        return any((mapped or address) in network for network in self._networks)

    def _user(self, authorization: str) -> str:
        """The user of Basic credentials (RFC 7617) with the proxy's secret; empty for any others."""
        scheme, _, credentials = authorization.partition(" ")
        if scheme.lower() != "basic":
            return ""
        try:
            user, _, secret = base64.b64decode(credentials.strip(), validate=True).partition(b":")
        except (binascii.Error, ValueError):
            return ""
        if not hmac.compare_digest(secret, self._secret):
            return ""
        name = user.decode(errors="replace").lower()
        return name if len(name) <= _LONGEST_USER and _USER.fullmatch(name) else ""


def _key_of(user: str, project: str, scope: Scope) -> Key:
    digest = hashlib.sha256(f"proxy {user}".encode()).hexdigest()
    # No key of the file holds an @, so nobody's counters are another's.
    name = user[:48] if "@" in user else f"{user[:48]}@proxy"
    return Key(id=digest[:16], name=name, scope=scope, project=project, sha256=digest, created="")


def _network(text: str) -> ipaddress.IPv4Network | ipaddress.IPv6Network:
    try:
        return ipaddress.ip_network(text)
    except ValueError:
        raise InputError(f"GRASPD_PROXY_ADDRESSES: {text!r} is no address; write 10.0.0.5 or 10.0.0.0/24") from None


def _rights(group: str, said: str) -> tuple[str, Scope]:
    project, _, scope = said.partition(":")
    if (project and not re.fullmatch(PATTERN, project)) or scope not in set(Scope):
        raise InputError(
            f"GRASPD_PROXY_GROUPS: {said!r} of {group!r} is no PROJECT:SCOPE; write vision:submit, or :admin for none"
        )
    return project, Scope(scope)
