"""How workers of other machines join the service of `graspd up`: its Redis asks for a password, a file tells it them.

The file is its user's alone, and meant for a folder that the machines of a cluster share. It appears whole, is written
anew by every start, and goes with the service that wrote it.
"""

from __future__ import annotations

import os
import secrets
import shlex
import socket
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from service.model.errors import InputError, UnavailableError
from service.settings import Settings


@dataclass(frozen=True)
class Joining:
    """Where the embedded Redis listens besides its socket."""

    file: Path
    host: str
    """Name or address by which the other machines reach this one."""
    address: str
    """Address of this machine that the name stands for: Redis listens there alone."""
    port: int
    password: str = field(repr=False)

    @property
    def redis_url(self) -> str:
        return f"redis://:{self.password}@{self.host}:{self.port}/0"

    def write(self, settings: Settings, api_url: str) -> None:
        """Say what workers need, as lines that a shell and `--env-file` read.

        Raises:
            UnavailableError: the folder cannot be written.
        """
        said = {
            "GRASPD_REDIS_URL": self.redis_url,
            "GRASPD_STORE_URL": settings.resolved_store_url,
            "GRASPD_API_URL": api_url,
        }
        text = "".join(f"{name}={shlex.quote(value)}\n" for name, value in said.items())
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(dir=self.file.parent, prefix=f".{self.file.name}.")
            with os.fdopen(handle, "w") as opened:
                opened.write(text)
                opened.flush()
                os.fsync(opened.fileno())
            Path(name).replace(self.file)
        except OSError as error:
            raise UnavailableError(f"{self.file} cannot be written: {error.strerror}") from None

    def forget(self) -> None:
        """Remove the file, unless another service wrote it meanwhile."""
        try:
            if self.redis_url in self.file.read_text():
                self.file.unlink(missing_ok=True)
        except OSError:
            return


def joining(settings: Settings, file: Path, *, host: str | None = None, port: int = 0) -> Joining:
    """An address, a free port (or `port`) and a fresh password.

    Args:
        host: how other machines call this one; its own name by default.

    Raises:
        InputError: Redis or the store are not ones that other machines can share through this file.
    """
    if settings.redis_url is not None:
        raise InputError("GRASPD_REDIS_URL names a Redis already: give that to the workers, and leave --share away")
    if settings.store_url is None:
        raise InputError("other machines need the store: set GRASPD_STORE_URL to file:///SHARED/FOLDER or s3://BUCKET")
    name = host or socket.gethostname()
    try:
        address = str(socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)[0][4][0])
        with socket.create_server(
            (address, port), family=socket.AF_INET6 if ":" in address else socket.AF_INET
        ) as probe:
            free = int(probe.getsockname()[1])
    except OSError as error:
        raise InputError(f"Redis cannot listen on {name}:{port or 'any'}: {error.strerror}; see --share-host") from None
    return Joining(file.resolve(), f"[{name}]" if ":" in name else name, address, free, secrets.token_hex(24))
