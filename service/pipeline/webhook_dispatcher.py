"""Webhook dispatcher: signed reports of ended jobs and datasets, with retries.

Each webhook has one delivery at a time; a failed one delays the others. Projects take turns; within a project, the
least recently used webhook comes first. Webhooks whose last delivery failed share half of the slots.
"""

import contextlib
import http.client
import ipaddress
import json
import logging
import math
import socket
import ssl
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import urlsplit

from graspd.service.index.outbox import DueDelivery
from graspd.service.index.views import EndView
from graspd.service.model.errors import InputError, UnavailableError
from graspd.service.model.planning import interleave
from graspd.service.model.webhooks import SIGNATURE, derive_secret, signature
from graspd.service.pipeline.backends import Services

log = logging.getLogger(__name__)
#: Maximum number of concurrent deliveries: in all, and of webhooks whose last delivery failed.
AT_ONCE: Final = 32
SLOW_AT_ONCE: Final = AT_ONCE // 2
_PAUSE_S: Final = 1.0
#: Interval [s] of checks for ended datasets, because the summary of a large dataset takes long.
_DATASETS_EVERY_S: Final = 5.0
_FORGET_EVERY_S: Final = 3600.0
PATIENCE_S: Final = 10.0
LOOK_UP_S: Final = 5.0
#: Maximum number of bytes to read of the body of a response.
_READ_BYTES: Final = 1024
#: IPv6 prefixes of mapped IPv4 addresses: the well-known one, and network-specific ones.
_NAT64: Final = ipaddress.ip_network("64:ff9b::/96")
_LOCAL_NAT64: Final = ipaddress.ip_network("64:ff9b:1::/48")
Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Networks = tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, ...]
#: Networks that are not public although `ipaddress` counts them as global: of clouds (Azure's host, IBM's services),
#: protocols (RFC 6890, RFC 7526) and documentation (RFC 9637).
_INSIDE: Final = tuple(
    ipaddress.ip_network(one)
    for one in ("168.63.129.16/32", "161.26.0.0/16", "166.8.0.0/14", "192.0.0.0/24", "192.88.99.0/24", "3fff::/20")
)


class RefusedAddress(InputError):
    """The address belongs to a machine that webhooks may not reach."""


@dataclass(frozen=True)
class Response:
    """Response to a delivery: HTTP status, None without a response; `detail` is a short text."""

    status: int | None
    detail: str = ""
    is_final: bool = False
    """Whether no retry follows, because the address is refused."""

    @property
    def is_accepted(self) -> bool:
        return self.status is not None and 200 <= self.status < 300


def parse_networks(text: str) -> Networks:
    """Parse networks that are separated by commas or spaces; InputError for an invalid one."""
    try:
        return tuple(ipaddress.ip_network(one) for one in text.replace(",", " ").split())
    except ValueError as error:
        raise InputError(f"GRASPD_WEBHOOK_NETWORKS: {error}; write 10.0.0.0/8") from None


def is_public(address: Address) -> bool:
    """Return whether an address, or the IPv4 address embedded in an IPv6 address, is public."""
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


def resolve_allowed_addresses(host: str, port: int, allowed: Networks) -> list[str]:
    """Return a host's addresses; OSError without any, RefusedAddress if one is not public or `allowed`."""
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
    """Send a body and return the response; errors become responses without a status."""
    parts = urlsplit(url)
    host = parts.hostname or ""
    port = parts.port or (443 if parts.scheme == "https" else 80)
    path = parts.path or "/"
    try:
        addresses = resolve_allowed_addresses(host, port, allowed)
        connection = _Connection(parts.scheme, host, port, addresses, patience_s)
    except RefusedAddress as error:
        return Response(None, str(error), is_final=True)
    except (OSError, ValueError):
        return Response(None, "the host of the address cannot be looked up")
    # The time-out of a socket restarts with each byte; this timer limits the whole exchange.
    end = threading.Timer(patience_s, connection.shut_down)
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
    """Connection to the first reachable of the checked addresses; the host is not resolved again."""

    def __init__(self, scheme: str, host: str, port: int, addresses: Sequence[str], patience_s: float) -> None:
        super().__init__(host, port)
        self.default_port = 443 if scheme == "https" else 80
        self._context = ssl.create_default_context() if scheme == "https" else None
        self._addresses = addresses
        self._end = time.monotonic() + patience_s

    def connect(self) -> None:
        dialled = self._dial()
        self.sock = self._context.wrap_socket(dialled, server_hostname=self.host) if self._context else dialled

    def shut_down(self) -> None:
        """Shut the connection down, from another thread."""
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


Post = Callable[..., Response]


class WebhookDispatcher:
    """Creates and starts deliveries, in a thread beside the controller's rounds."""

    def __init__(self, services: Services, stop: threading.Event, *, send: Post = post) -> None:
        self._services = services
        self._stop = stop
        self._send = send
        secret = services.settings.webhook_secret
        self._master = secret.get_secret_value() if secret else ""
        self._allowed: Networks = parse_networks(services.settings.webhook_networks or "")
        self._forget_again = -math.inf
        self._lock = threading.Lock()
        self._under_way: dict[str, DueDelivery] = {}
        self._ended = threading.Event()
        #: Time of the last attempt of each webhook, and whether it failed.
        self._last: dict[str, tuple[float, bool]] = {}
        self._pool = ThreadPoolExecutor(AT_ONCE, thread_name_prefix="webhooks")

    def run(self) -> None:
        look_again = -math.inf
        while not self._stop.is_set():
            # The end of a delivery starts the next one of its webhook at once.
            self._ended.wait(_PAUSE_S)
            self._ended.clear()
            try:
                if time.monotonic() > look_again:
                    self.report_dataset_ends()
                    look_again = time.monotonic() + _DATASETS_EVERY_S
                self.start_deliveries()
            except UnavailableError as error:
                log.warning("webhooks wait: %s", error)
            except Exception:
                log.exception("a round of webhooks failed")
        self._pool.shutdown(wait=False, cancel_futures=True)

    def start_deliveries(self, *, now: float | None = None) -> list[Future[None]]:
        """Create deliveries of newly ended jobs and datasets; start due ones while slots are free."""
        out = self._services.index.outbox
        if time.monotonic() > self._forget_again:
            out.delete_expired()
            self._forget_again = time.monotonic() + _FORGET_EVERY_S
        if not self._master:
            return []
        out.create_deliveries()
        started = []
        for due in self._fair_order(out.due_deliveries(time.time() if now is None else now)):
            with self._lock:
                slow = sum(map(self._has_failed, self._under_way.values()))
                full = len(self._under_way) >= AT_ONCE or (self._has_failed(due) and slow >= SLOW_AT_ONCE)
                if full or due.hook.id in self._under_way:
                    continue
                self._under_way[due.hook.id] = due
            started.append(self._pool.submit(self._attempt, due))
        return started

    def _fair_order(self, found: list[DueDelivery]) -> list[DueDelivery]:
        """Order deliveries round-robin over projects (or keys), the least recently used webhooks first."""
        of_project: dict[str, list[DueDelivery]] = {}
        for due in sorted(found, key=lambda one: self._last.get(one.hook.id, (0.0, False))):
            of_project.setdefault(due.hook.project or f"key {due.hook.owner}", []).append(due)
        return interleave(list(of_project.values()))

    def _has_failed(self, due: DueDelivery) -> bool:
        return due.attempts > 0 or self._last.get(due.hook.id, (0.0, False))[1]

    def report_dataset_ends(self) -> None:
        untold = dict(self._services.index.outbox.unreported_datasets())
        for name in untold.keys() - self._services.index.datasets.unfinished(untold):
            dataset = self._services.index.datasets.get(name)
            row = {"kind": "dataset", "subject": name, "state": dataset.state.value}
            row |= {"project": dataset.project, "owner": dataset.owner}
            self._services.index.outbox.report_dataset_end(name, untold[name], row)

    def _attempt(self, due: DueDelivery) -> None:
        is_settled = False
        try:
            self._deliver(due)
            is_settled = True
        except UnavailableError as error:
            log.warning("a webhook waits: %s", error)
        except Exception:
            log.exception("a delivery failed")
        finally:
            with self._lock:
                del self._under_way[due.hook.id]
            if is_settled:
                self._ended.set()

    def _deliver(self, due: DueDelivery) -> None:
        body = webhook_body(due.end)
        at = int(time.time())
        headers = {
            "Content-Type": "application/json",
            "User-Agent": "graspd-webhook",
            "X-Graspd-Delivery": f"{due.hook.id}-{due.end.seq}",
            SIGNATURE: signature(derive_secret(self._master, due.hook.id), at, body),
        }
        answer = self._send(due.hook.url, body, headers, allowed=self._allowed)
        done = answer.is_accepted
        self._last[due.hook.id] = (time.monotonic(), not done)
        outbox = self._services.index.outbox
        outbox.record_attempt(due, status=answer.status, detail=answer.detail, done=done, final=answer.is_final)


def webhook_body(end: EndView) -> bytes:
    return json.dumps(end.model_dump(mode="json"), sort_keys=True, separators=(",", ":")).encode()
