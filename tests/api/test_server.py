"""The socket of the API."""

from __future__ import annotations

import asyncio
import socket

from graspd.api.server import bind


def test_answers_are_sent_without_delay() -> None:
    """Else Nagle holds an answer's body back for the 40 ms that a client waits before it acknowledges the head."""

    async def option() -> int:
        found: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        def accepted(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            connection = writer.get_extra_info("socket")
            found.set_result(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            writer.close()

        async with await asyncio.start_server(accepted, sock=bind("127.0.0.1", 0)) as server:
            _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
            value = await found
            writer.close()
            await writer.wait_closed()
            return value

    assert asyncio.run(option()) == 1
