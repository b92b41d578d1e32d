"""One uvicorn server for the application, in this process, on a socket that is bound first.

uvicorn limits the time between requests, and `BodyLimit` the time between pieces of a body. `TimedProtocol` limits the
time for headers, and for the rest of a body after its response: each byte of this rest restarts uvicorn's limit.
"""

import asyncio
import os
import socket
import sys
import tempfile
from typing import Final

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

from graspd.api.app import create_app
from graspd.service.run.address import bind_socket
from graspd.service.settings import Settings

#: Longest wait of a stopping server for event streams [s], because only clients end them.
_GRACE_S = 3
_TOO_SLOW: Final = b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


def serve(settings: Settings) -> None:
    listener = bind_socket(settings.host, settings.port)
    with listener:
        listener.listen(socket.SOMAXCONN)
        # Uploads are spooled in this folder, because /tmp may be in memory.
        spool = settings.data_dir / "uploads"
        spool.mkdir(parents=True, exist_ok=True)
        tempfile.tempdir = str(spool)
        app = create_app(settings)
        host, port = listener.getsockname()[:2]
        shown = f"[{host}]" if ":" in host else host
        print(f"graspd answers at http://{shown}:{port}", file=sys.stderr, flush=True)  # noqa: T201
        uvicorn.Server(configuration(app, settings)).run(sockets=[listener])


def configuration(app: ASGIApp, settings: Settings) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        http=TimedProtocol,
        ws="none",
        # A trusted proxy may state any client address, and so evade limits per address; so none is trusted by default.
        proxy_headers=bool(os.environ.get("FORWARDED_ALLOW_IPS")),
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=_GRACE_S,
        server_header=False,
        log_level=settings.log_level.lower(),
    )


class TimedProtocol(H11Protocol):
    """HTTP/1.1 connection with time limits that single bytes do not extend."""

    #: Time limit from the start of a connection, or the first byte of a later request, to the end of its headers [s].
    headers_s = 20.0
    #: Time limit for the rest of a body after its response [s].
    rest_s = 5.0
    _patience: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._start_timer()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._update_timer()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self.conn.their_state is h11.SEND_BODY:
            self.loop.call_later(self.rest_s, self._drop_rest, self.cycle)
        # uvicorn now reads pipelined data.
        self._update_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_timer()
        super().connection_lost(exc)

    def _update_timer(self) -> None:
        if self.conn.their_state is not h11.IDLE:
            self._stop_timer()
        elif self.conn.trailing_data[0]:
            self._start_timer()

    def _start_timer(self) -> None:
        if self._patience is None and not self.transport.is_closing():
            self._patience = self.loop.call_later(self.headers_s, self._time_out)

    def _stop_timer(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None

    def _time_out(self) -> None:
        if self.conn.trailing_data[0] and not self.transport.is_closing():
            self.transport.write(_TOO_SLOW)
        self.transport.close()

    def _drop_rest(self, answered: RequestResponseCycle) -> None:
        if self.cycle is answered and self.conn.their_state is h11.SEND_BODY:
            self.transport.close()
