"""HEAD wherever there is GET (RFC 9110 §9.3.2): the same answer without its body."""

from __future__ import annotations

from starlette.routing import Match
from starlette.types import ASGIApp, Message, Receive, Scope, Send


class Head:
    """Answers HEAD as GET where no route takes HEAD itself."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "HEAD" or _is_taken(scope):
            await self.app(scope, receive, send)
            return

        is_over = False

        async def without_body(message: Message) -> None:
            nonlocal is_over
            if message["type"] == "http.response.start":
                await send(message)
                # A stream that may never end hears that its client is gone; what has a length closes its files itself.
                is_last = all(name.lower() != b"content-length" for name, _ in message["headers"])
            else:
                is_last = not message.get("more_body", False)
            if is_last and not is_over:
                is_over = True
                await send({"type": "http.response.body", "body": b"", "more_body": False})

        headers = scope["headers"]
        scope["method"], scope["headers"] = "GET", [one for one in headers if one[0] != b"range"]
        try:
            await self.app(scope, receive, without_body)
        finally:
            scope["method"], scope["headers"] = "HEAD", headers


def _is_taken(scope: Scope) -> bool:
    return any(route.matches(dict(scope))[0] is Match.FULL for route in scope["app"].routes)
