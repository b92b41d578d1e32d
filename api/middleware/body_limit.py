"""Limits on what a stranger may send: who may send a body at all, its bytes while they arrive, and their time."""

from __future__ import annotations

import asyncio
import time
from typing import Final

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from graspd.api.access.auth import authorize
from graspd.api.access.keys import Scope as KeyScope
from graspd.api.middleware.request_context import SAFE_METHODS
from graspd.api.problems import ApiError, answer
from graspd.service.model.errors import LimitError

#: A JSON body or a form without a file: job requests are a few hundred bytes.
MAX_BODY_BYTES: Final = 1 << 20
#: Longest wait for the next piece of a body [s].
PIECE_S: Final = 30.0
#: A body that comes slower is given up: a byte now and then would hold a connection for ever [bytes/s].
LEAST_BYTES_S: Final = 16 << 10
#: Multipart framing and the other fields of an upload.
_FORM_SLACK_BYTES: Final = 64 << 10
#: Of a Content-Length: Python takes long to read a number of thousands, or refuses it.
_MOST_DIGITS: Final = 18


class BodyLimit:
    """Refuses a body over the limit by its Content-Length, and stops reading one that turns out longer or too slow.

    Args:
        upload_paths: paths that take files.
        upload_bytes: largest file [bytes].
        piece_s: longest wait for the next piece of a body [s].
    """

    def __init__(
        self, app: ASGIApp, *, upload_paths: frozenset[str], upload_bytes: int, piece_s: float = PIECE_S
    ) -> None:
        self.app = app
        self.upload_paths = upload_paths
        self.upload_bytes = upload_bytes
        self.piece_s = piece_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        is_upload = scope["method"] == "POST" and scope["path"].rstrip("/") in self.upload_paths
        limit = self.upload_bytes + _FORM_SLACK_BYTES if is_upload else MAX_BODY_BYTES
        given = dict(scope["headers"])
        if b"transfer-encoding" in given and b"content-length" in given:
            # Two lengths: a proxy may have taken the other one, and what is left would be read as the next request.
            await _refuse(
                ApiError(400, "Transfer-Encoding and Content-Length exclude each other"), scope, receive, send
            )
            return
        encoding = given.get(b"content-encoding", b"").decode("latin-1").strip().lower()
        if encoding not in ("", "identity") and scope["method"] not in SAFE_METHODS:
            await _refuse(_encoded(encoding), scope, receive, send)
            return
        declared = given.get(b"content-length", b"0")
        if not declared.isdigit() or len(declared) > _MOST_DIGITS or int(declared) > limit:
            await _refuse(_too_large(limit), scope, receive, send)
            return
        if declared != b"0" or b"transfer-encoding" in given:
            try:
                self._authorize(scope, is_upload)
            except ApiError as error:
                await _refuse(error, scope, receive, send)
                return
        await self._watch(scope, receive, send, limit)

    @staticmethod
    def _authorize(scope: Scope, is_upload: bool) -> None:
        """Nothing is read, and nothing kept, of a body that somebody sends who may not; routes ask for more."""
        if is_upload:
            authorize(Request(scope), KeyScope.SUBMIT)
        elif scope["path"].startswith("/v1/"):
            authorize(Request(scope), KeyScope.READ)

    async def _watch(self, scope: Scope, receive: Receive, send: Send, limit: int) -> None:
        received, began = 0, time.monotonic()
        is_whole = is_answered = False
        refusal: Exception | None = None

        async def counted() -> Message:
            nonlocal received, is_whole, refusal
            try:
                # After the body only the end of the connection is awaited, for as long as the answer takes.
                async with asyncio.timeout(None if is_whole else self.piece_s):
                    message = await receive()
            except TimeoutError:
                refusal = ApiError(408, f"no piece of the body came for {self.piece_s:g} s; send it again")
                return {"type": "http.disconnect"}
            is_whole = not message.get("more_body", False)
            received += len(message.get("body", b""))
            late = time.monotonic() - began - self.piece_s
            if not is_whole and received < late * LEAST_BYTES_S:
                refusal = ApiError(408, f"the body comes at less than {LEAST_BYTES_S >> 10} KiB/s; send it again")
                return {"type": "http.disconnect"}
            if received > limit:
                refusal = _too_large(limit)
                # The application sees a client that went away and stops; its answer is replaced below.
                return {"type": "http.disconnect"}
            return message

        async def guarded(message: Message) -> None:
            nonlocal is_answered
            if refusal is not None and not is_answered:
                return
            is_answered = True
            await send(message)

        await self.app(scope, counted, guarded)
        if refusal is not None and not is_answered:
            await _refuse(refusal, scope, receive, send)


def _too_large(limit: int) -> LimitError:
    return LimitError(f"the body is larger than {limit} bytes; send a smaller one")


def _encoded(encoding: str) -> ApiError:
    return ApiError(
        415,
        f"the body has Content-Encoding {encoding[:40]!r}, and only plain bodies are read; send it as it is",
        headers={"Accept-Encoding": "identity"},
    )


async def _refuse(error: Exception, scope: Scope, receive: Receive, send: Send) -> None:
    response = answer(Request(scope), error)
    response.headers["Connection"] = "close"
    await response(scope, receive, send)
