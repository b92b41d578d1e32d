"""Runs the application: one uvicorn in this process, on a socket that was bound before anything else was done."""

from __future__ import annotations

import errno
import os
import socket
import sys
import tempfile

import uvicorn
from starlette.types import ASGIApp

from api.app import create_app
from api.middleware.protocol import TimedProtocol
from service.model.errors import BusyError, InputError
from service.settings import Settings

#: Open event streams end with their clients; a stop does not wait longer than this.
_GRACE_S = 3


def bind(host: str, port: int) -> socket.socket:
    """A listening socket.

    Raises:
        BusyError: the port is taken.
        InputError: the address is none of this machine, or the port needs other rights.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio sends without delay only on sockets that name their protocol; else each answer waits 40 ms for its body.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(socket.SOMAXCONN)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise BusyError(f"port {port} on {host} is taken; stop what uses it, or choose another: --port 0") from None
        raise InputError(f"{host}:{port} cannot be bound: {error.strerror or error}") from None
    return listener


def serve(settings: Settings) -> None:
    """Answer requests until SIGINT or SIGTERM.

    Raises:
        BusyError: the port is taken.
        InputError: strangers could reach the service without a key.
        StoreUnavailable, IndexUnavailable: where they cannot be opened.
    """
    listener = bind(settings.host, settings.port)
    with listener:
        # Uploads wait here, not in /tmp, which may be memory.
        spool = settings.data_dir / "uploads"
        spool.mkdir(parents=True, exist_ok=True)
        tempfile.tempdir = str(spool)
        app = create_app(settings)
        host, port = listener.getsockname()[:2]
        shown = f"[{host}]" if ":" in host else host
        print(f"graspd answers at http://{shown}:{port}", file=sys.stderr, flush=True)  # noqa: T201
        uvicorn.Server(configuration(app, settings)).run(sockets=[listener])


def configuration(app: ASGIApp, settings: Settings) -> uvicorn.Config:
    """How uvicorn serves the application."""
    return uvicorn.Config(
        app,
        http=TimedProtocol,
        ws="none",
        # Whoever is believed may name any address as its client's, and so evade what is counted by address: nobody is,
        # loopback included, unless the variable says so.
        proxy_headers=bool(os.environ.get("FORWARDED_ALLOW_IPS")),
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=_GRACE_S,
        server_header=False,
        log_level=settings.log_level.lower(),
    )
