"""Limits on what a stranger may send: bytes of a body, while they arrive."""

from __future__ import annotations

from typing import Final

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.problems import problem_response
from service.errors import LimitError

#: A JSON body or a form without a file: job requests are a few hundred bytes.
MAX_BODY_BYTES: Final = 1 << 20
#: Multipart framing and the other fields of an upload.
_FORM_SLACK_BYTES: Final = 64 << 10


class BodyLimit:
    """Refuses a body over the limit by its Content-Length, and stops reading one that turns out longer.

    Args:
        upload_paths: paths that take files.
        upload_bytes: largest file [bytes].
    """

    def __init__(self, app: ASGIApp, *, upload_paths: frozenset[str], upload_bytes: int) -> None:
        self.app = app
        self.upload_paths = upload_paths
        self.upload_bytes = upload_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        is_upload = scope["method"] == "POST" and scope["path"].rstrip("/") in self.upload_paths
        limit = self.upload_bytes + _FORM_SLACK_BYTES if is_upload else MAX_BODY_BYTES
        declared = dict(scope["headers"]).get(b"content-length", b"0")
        if not declared.isdigit() or int(declared) > limit:
            await self._refuse(scope, receive, send, limit)
            return
        await self._watch(scope, receive, send, limit)

    async def _watch(self, scope: Scope, receive: Receive, send: Send, limit: int) -> None:
        received = 0
        is_over = False
        is_answered = False

        async def counted() -> Message:
            nonlocal received, is_over
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit:
                is_over = True
                # The application sees a client that went away and stops; its answer is replaced below.
                return {"type": "http.disconnect"}
            return message

        async def guarded(message: Message) -> None:
            nonlocal is_answered
            if is_over and not is_answered:
                return
            is_answered = True
            await send(message)

        await self.app(scope, counted, guarded)
        if is_over and not is_answered:
            await self._refuse(scope, receive, send, limit)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, limit: int) -> None:
        response = problem_response(
            scope["path"],
            scope.get("state", {}).get("request_id"),
            slug=LimitError.slug,
            title=LimitError.title,
            status=LimitError.status,
            detail=f"the body is larger than {limit} bytes; send a smaller one",
            headers={"Connection": "close"},
        )
        await response(scope, receive, send)
