"""HTTP client of webhooks: POST to a user's URL, on public machines only, with bounded time and bytes.

The name is resolved here, all its addresses are checked, and the connection uses one of them. A name that later
resolves to another machine (DNS rebinding) thus has no effect. Redirects are not followed.
"""

from __future__ import annotations

import contextlib
import http.client
import ipaddress
import socket
import ssl
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import urlsplit

from graspd.service.model.errors import InputError

PATIENCE_S: Final = 10.0
LOOK_UP_S: Final = 5.0
#: Most bytes read of the answer after its status line and headers.
_READ_BYTES: Final = 1024
#: Prefixes that map IPv4 addresses: the well-known one, and network-specific ones.
_NAT64: Final = ipaddress.ip_network("64:ff9b::/96")
_LOCAL_NAT64: Final = ipaddress.ip_network("64:ff9b:1::/48")
Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Networks = tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, ...]
#: Addresses that the library counts as global although only internal machines reach them: of clouds (Azure's host,
#: IBM's services), of protocols (RFC 6890, RFC 7526), of documentation (RFC 9637).
_INSIDE: Final = tuple(
    ipaddress.ip_network(one)
    for one in ("168.63.129.16/32", "161.26.0.0/16", "166.8.0.0/14", "192.0.0.0/24", "192.88.99.0/24", "3fff::/20")
)


class RefusedAddress(InputError):
    """The address belongs to a machine that webhooks may not reach."""


@dataclass(frozen=True)
class Response:
    """Response to a delivery: a status, or a short reason for its absence."""

    status: int | None
    detail: str = ""
    is_final: bool = False
    """Whether a retry is useless because the address is refused."""

    @property
    def is_taken(self) -> bool:
        return self.status is not None and 200 <= self.status < 300


def networks(text: str) -> Networks:
    """Parse networks of a setting, separated by commas or spaces; InputError for an invalid one."""
    try:
        return tuple(ipaddress.ip_network(one) for one in text.replace(",", " ").split())
    except ValueError as error:
        raise InputError(f"GRASPD_WEBHOOK_NETWORKS: {error}; write 10.0.0.0/8") from None


def is_public(address: Address) -> bool:
    """Check whether an address is public; an IPv6 address also by the IPv4 address in it.

    Loopback, private, link-local, shared, multicast and reserved addresses are not public.
    """
    if any(address in network for network in _INSIDE):
        return False
    if isinstance(address, ipaddress.IPv6Address):
        inner = address.ipv4_mapped or address.sixtofour or (address.teredo[1] if address.teredo else None)
        if address in _NAT64:
            inner = ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
        if inner is not None:
            return is_public(inner)
        if address.is_site_local or address in _LOCAL_NAT64:
            return False
    return address.is_global and not address.is_multicast and not address.is_reserved


def reachable(host: str, port: int, allowed: Networks) -> list[str]:
    """Return a host's addresses; RefusedAddress unless all are public or in `allowed`, OSError without any."""
    found = list(dict.fromkeys(str(info[4][0]) for info in _resolve_host(host, port)))
    for one in found:
        address = ipaddress.ip_address(one.partition("%")[0])
        if not is_public(address) and not any(address in network for network in allowed):
            raise RefusedAddress("the address is not public; the operator can allow it: GRASPD_WEBHOOK_NETWORKS")
    return found


def _resolve_host(host: str, port: int) -> list[Any]:
    """Return the addresses of a host; OSError if it has none, or after `LOOK_UP_S`."""
    found: list[Any] = []

    def look_up() -> None:
        with contextlib.suppress(OSError, ValueError):
            found.extend(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM))

    # The system's resolver has no time limit: a blocked thread is abandoned.
    thread = threading.Thread(target=look_up, daemon=True, name="look-up")
    thread.start()
    thread.join(LOOK_UP_S)
    if not found:
        raise OSError("no address")
    return found


def post(
    url: str, body: bytes, headers: Mapping[str, str], *, allowed: Networks = (), patience_s: float = PATIENCE_S
) -> Response:
    """Send a body and return the status of the answer; never raises."""
    parts = urlsplit(url)
    host = parts.hostname or ""
    port = parts.port or (443 if parts.scheme == "https" else 80)
    path = parts.path or "/"
    try:
        addresses = reachable(host, port, allowed)
        connection = _Connection(parts.scheme, host, port, addresses, patience_s)
    except RefusedAddress as error:
        return Response(None, str(error), is_final=True)
    except (OSError, ValueError):
        return Response(None, "the host of the address cannot be looked up")
    # A socket's time-out restarts with each byte; this timer limits the whole exchange.
    end = threading.Timer(patience_s, connection.cut)
    end.daemon = True
    end.start()
    try:
        connection.request("POST", f"{path}?{parts.query}" if parts.query else path, body=body, headers=dict(headers))
        answer = connection.getresponse()
        answer.read(_READ_BYTES)
        moved = "; redirects are not followed" if 300 <= answer.status < 400 else ""
        return Response(answer.status, f"answered {answer.status}{moved}")
    except (OSError, http.client.HTTPException, ValueError) as error:
        return Response(None, f"{type(error).__name__}: {str(error)[:150]}" if str(error) else "no answer in time")
    finally:
        end.cancel()
        connection.close()


class _Connection(http.client.HTTPConnection):
    """Connection to one of the checked addresses, within `patience_s`; the library would resolve the name again."""

    def __init__(self, scheme: str, host: str, port: int, addresses: Sequence[str], patience_s: float) -> None:
        super().__init__(host, port)
        self.default_port = 443 if scheme == "https" else 80
        self._context = ssl.create_default_context() if scheme == "https" else None
        self._addresses = addresses
        self._end = time.monotonic() + patience_s

    def connect(self) -> None:
        dialled = self._dial()
        self.sock = self._context.wrap_socket(dialled, server_hostname=self.host) if self._context else dialled

    def cut(self) -> None:
        """Close the connection from another thread, in any state."""
        with contextlib.suppress(OSError):
            if self.sock is not None:
                self.sock.shutdown(socket.SHUT_RDWR)

    def _dial(self) -> socket.socket:
        last: OSError = OSError("no address")
        for address in self._addresses:
            if (left_s := self._end - time.monotonic()) <= 0:
                break
            try:
                return socket.create_connection((address, self.port), timeout=left_s)
            except OSError as error:
                last = error
        raise last
