"""Who asks, where a proxy in front has signed people in (OIDC): believed only from its address and with its secret.

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
from typing import Final

from starlette.datastructures import Headers
from starlette.types import Scope as AsgiScope

from api.access.keys import Key, Scope
from service.model.errors import InputError
from service.model.projects import PATTERN
from service.settings import Settings

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
