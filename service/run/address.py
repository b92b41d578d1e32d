"""Addresses of a running service: its URL, and access for workers on other machines.

The record of the URL names its writer, and is ignored after a crash of that process. The file for other machines is
private to its user and meant for a shared folder of a cluster. The end of the service removes the file.
"""

import contextlib
import errno
import json
import os
import secrets
import shlex
import socket
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from graspd.service.model.errors import BusyError, InputError, UnavailableError
from graspd.service.run.children import start_time
from graspd.service.settings import Settings
from graspd.service.user_cache import write_atomically

_FILE: Final = "api.json"


def record_address(folder: Path, url: str) -> None:
    """Record `url` as the address of the service of this process."""
    record = {"api_url": url, "pid": os.getpid(), "started": start_time(os.getpid())}
    write_atomically(folder / _FILE, [json.dumps(record).encode()])


def local_url(host: str, port: int) -> str:
    """Return the local URL of an API that binds to a host; for 0.0.0.0 or ::, the loopback URL."""
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return f"http://{shown}:{port}"


def bind_socket(host: str, port: int) -> socket.socket:
    """Bind a socket to a port (0: a free port). BusyError: port in use. InputError: unusable address.

    While the socket is open, the API of a child process can listen on the port, and no other process gets the port.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio disables Nagle's algorithm, which delays bodies by 40 ms, only on sockets with an explicit protocol.
    bound = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((host, port))
    except OSError as error:
        bound.close()
        if error.errno == errno.EADDRINUSE:
            fix = "stop its process, or choose another port with --port or GRASPD_PORT"
            raise BusyError(f"port {port} on {host} is in use; {fix}") from None
        raise InputError(f"the address {host}:{port} cannot be used: {error.strerror or error}") from None
    return bound


def forget_address(folder: Path) -> None:
    record = _read_record(folder)
    if record is not None and record[1] == os.getpid():
        with contextlib.suppress(OSError):
            (folder / _FILE).unlink(missing_ok=True)


def recorded_address(folder: Path) -> str | None:
    """Return the recorded URL of a data folder's service; None without a record of a living process."""
    record = _read_record(folder)
    return record[0] if record is not None and start_time(record[1]) == record[2] else None


def _read_record(folder: Path) -> tuple[str, int, str] | None:
    try:
        file = folder / _FILE
        # The file of another user could direct this user's key to a foreign server.
        if file.stat().st_uid not in (os.getuid(), 0):
            return None
        record = json.loads(file.read_text())
        url, pid, started = record["api_url"], record["pid"], record["started"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    known = isinstance(url, str) and url.startswith(("http://", "https://")) and isinstance(pid, int) and started
    return (url, pid, started) if known else None


@dataclass(frozen=True)
class ListenAddress:
    """Address of the embedded Redis besides its socket."""

    file: Path
    host: str
    address: str
    """Address to which the name of this machine resolves; Redis listens only on this address."""
    port: int
    password: str = field(repr=False)

    @property
    def redis_url(self) -> str:
        return f"redis://:{self.password}@{self.host}:{self.port}/0"

    def write(self, settings: Settings, api_url: str) -> None:
        """Write the settings of workers as lines for a shell or `--env-file`; UnavailableError on failure."""
        urls = {"REDIS": self.redis_url, "STORE": settings.resolved_store_url, "API": api_url}
        text = "".join(f"GRASPD_{name}_URL={shlex.quote(value)}\n" for name, value in urls.items())
        try:
            write_atomically(self.file, [text.encode()])
        except OSError as error:
            raise UnavailableError(f"{self.file} cannot be written: {error.strerror}") from None

    def forget(self) -> None:
        """Remove the file, unless another service has overwritten it."""
        with contextlib.suppress(OSError):
            if self.redis_url in self.file.read_text():
                self.file.unlink(missing_ok=True)


def new_listen_address(settings: Settings, file: Path, *, host: str | None = None, port: int = 0) -> ListenAddress:
    """Return an address of this machine with port `port` (0: a free port) and a new password.

    InputError: the settings name a Redis, which needs no file, or no store that other machines can reach.
    """
    if settings.redis_url is not None:
        raise InputError("GRASPD_REDIS_URL is already set: give it to the workers, and omit --share")
    if settings.store_url is None:
        raise InputError("other machines need the store: set GRASPD_STORE_URL to file:///SHARED/FOLDER or s3://BUCKET")
    name = host or socket.gethostname()
    try:
        address = str(socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)[0][4][0])
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        with socket.create_server((address, port), family=family) as probe:
            free = int(probe.getsockname()[1])
    except OSError as error:
        raise InputError(f"Redis cannot listen on {name}:{port or 'any'}: {error.strerror}; see --share-host") from None
    return ListenAddress(file.resolve(), f"[{name}]" if ":" in name else name, address, free, secrets.token_hex(24))
