"""HTTP/1.1 as uvicorn speaks it, with an end to the patience for the headers of a request.

uvicorn counts the time between requests, and `BodyLimit` that between the pieces of a body; without this a connection
that sends half of its headers, or none, is kept for ever. So is one that goes on with a body after its answer: nobody
reads that body any more, and each byte of it begins the time between requests anew.
"""

from __future__ import annotations

import asyncio
from typing import Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

#: From the start of a connection, or the first byte of a later request, to the end of its headers [s].
HEADERS_S: Final = 20.0
#: For what is left of a body after its answer [s]: who is still sending it may read the answer first.
REST_S: Final = 5.0
_TOO_SLOW: Final = b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


class TimedProtocol(H11Protocol):
    """One connection. Bytes that trickle in win no time."""

    headers_s = HEADERS_S
    rest_s = REST_S
    _patience: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._begin()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._look()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self.conn.their_state is h11.SEND_BODY:
            self.loop.call_later(self.rest_s, self._drop_rest, self.cycle)
        # What was sent behind the request is read now.
        self._look()

    def connection_lost(self, exc: Exception | None) -> None:
        self._end()
        super().connection_lost(exc)

    def _look(self) -> None:
        if self.conn.their_state is not h11.IDLE:
            self._end()
        elif self.conn.trailing_data[0]:
            self._begin()

    def _begin(self) -> None:
        if self._patience is None and not self.transport.is_closing():
            self._patience = self.loop.call_later(self.headers_s, self._give_up)

    def _end(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None

    def _give_up(self) -> None:
        if self.conn.trailing_data[0] and not self.transport.is_closing():
            self.transport.write(_TOO_SLOW)
        self.transport.close()

    def _drop_rest(self, answered: RequestResponseCycle) -> None:
        if self.cycle is answered and self.conn.their_state is h11.SEND_BODY:
            self.transport.close()
