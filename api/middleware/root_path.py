"""The service below a path of a proxy: `https://host/graspd/` instead of `https://host/`.

Inside, all paths are as without it. What comes in with the prefix loses it here, where the proxy has not taken it away
already; addresses that leave in headers get it. Those in pages get it where they are rendered (`with_prefix`).
"""

from __future__ import annotations

import re
from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

#: An attribute whose value is an address on this host. What a user wrote holds no quotes in a page.
_ADDRESS: Final = re.compile(r'(?<=\s)((?:href|src|action|formaction|hx-[a-z-]+|data-[a-z-]+)=")(?=/(?!/))')
_COOKIE_PATH: Final = re.compile(r";\s*Path=/(?=;|$)", re.IGNORECASE)


class RootPath:
    """Takes the prefix off paths and puts it on `Location` and on the path of cookies.

    Args:
        prefix: such as `/graspd`.
    """

    def __init__(self, app: ASGIApp, *, prefix: str) -> None:
        self.app = app
        self.prefix = prefix

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        if scope["path"] == self.prefix or scope["path"].startswith(f"{self.prefix}/"):
            scope = {**scope, "path": scope["path"].removeprefix(self.prefix) or "/"}
            if raw := scope.get("raw_path"):
                scope["raw_path"] = raw.removeprefix(self.prefix.encode()) or b"/"
        host = Headers(scope=scope).get("host", "")

        async def prefixed(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if (where := headers.get("location")) is not None:
                    headers["location"] = self._below(where, host)
                if cookies := headers.getlist("set-cookie"):
                    del headers["set-cookie"]
                    for cookie in cookies:
                        headers.append("set-cookie", _COOKIE_PATH.sub(f"; Path={self.prefix}", cookie))
            await send(message)

        await self.app(scope, receive, prefixed)

    def _below(self, where: str, host: str) -> str:
        parts = urlsplit(where)
        if parts.netloc not in ("", host) or not parts.path.startswith("/"):
            return where  # a signed address of the store, say
        return parts._replace(path=f"{self.prefix}{parts.path}").geturl()


def with_prefix(page: str, prefix: str) -> str:
    """A page whose addresses on this host begin with the prefix."""
    return _ADDRESS.sub(rf"\g<1>{prefix}", page) if prefix else page
