"""Limits on request bodies: permission to send one, its size on arrival, and its duration."""

from __future__ import annotations

import asyncio
import time
from typing import Final

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from graspd.api.access.auth import authorize
from graspd.api.access.keys import Scope as KeyScope
from graspd.api.middleware.request_context import SAFE_METHODS, HttpMiddleware
from graspd.api.problems import ApiError, answer
from graspd.service.model.errors import LimitError

#: Limit of a JSON body or a form without a file: job requests take a few hundred bytes.
MAX_BODY_BYTES: Final = 1 << 20
PIECE_S: Final = 30.0
#: Least rate of a body; without it, single bytes would hold a connection forever [bytes/s].
LEAST_BYTES_S: Final = 16 << 10
#: Allowance for multipart framing and the other fields of an upload.
_FORM_SLACK_BYTES: Final = 64 << 10
#: Most digits of a Content-Length: Python parses thousands of digits slowly, or refuses them.
_MOST_DIGITS: Final = 18


class BodyLimit(HttpMiddleware):
    """Refuses bodies whose Content-Length exceeds the limit; aborts those that become too long or slow."""

    def __init__(
        self, app: ASGIApp, *, upload_paths: frozenset[str], upload_bytes: int, piece_s: float = PIECE_S
    ) -> None:
        super().__init__(app)
        self.upload_paths = upload_paths
        self.upload_bytes = upload_bytes
        self.piece_s = piece_s

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        is_upload = scope["method"] == "POST" and scope["path"].rstrip("/") in self.upload_paths
        limit = self.upload_bytes + _FORM_SLACK_BYTES if is_upload else MAX_BODY_BYTES
        if (refusal := _refusal(scope, limit, is_upload=is_upload)) is not None:
            await _refuse(refusal, scope, receive, send)
            return
        await self._watch(scope, receive, send, limit)

    async def _watch(self, scope: Scope, receive: Receive, send: Send, limit: int) -> None:
        received, began = 0, time.monotonic()
        is_whole = is_answered = False
        refusal: Exception | None = None

        async def counted() -> Message:
            nonlocal received, is_whole, refusal
            try:
                # After the body, only a disconnect can arrive, and the answer may take any time.
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
                # Simulate a disconnect, so that the application stops; its answer is replaced below.
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


def _refusal(scope: Scope, limit: int, *, is_upload: bool) -> Exception | None:
    """Return why a body is refused before it is read; None: it is not."""
    given = dict(scope["headers"])
    if b"transfer-encoding" in given and b"content-length" in given:
        # Two lengths: a proxy may have used the other one, and the remainder would be read as the next request.
        return ApiError(400, "Transfer-Encoding and Content-Length exclude each other")
    encoding = given.get(b"content-encoding", b"").decode("latin-1").strip().lower()
    if encoding not in ("", "identity") and scope["method"] not in SAFE_METHODS:
        return ApiError(
            415,
            f"the body has Content-Encoding {encoding[:40]!r}, and only plain bodies are read; send it as it is",
            headers={"Accept-Encoding": "identity"},
        )
    declared = given.get(b"content-length", b"0")
    if not declared.isdigit() or len(declared) > _MOST_DIGITS or int(declared) > limit:
        return _too_large(limit)
    if declared != b"0" or b"transfer-encoding" in given:
        try:
            # Routes check further.
            if is_upload:
                authorize(Request(scope), KeyScope.SUBMIT)
            elif scope["path"].startswith("/v1/"):
                authorize(Request(scope), KeyScope.READ)
        except ApiError as error:
            return error
    return None


def _too_large(limit: int) -> LimitError:
    return LimitError(f"the body is larger than {limit} bytes; send a smaller one")


async def _refuse(error: Exception, scope: Scope, receive: Receive, send: Send) -> None:
    response = answer(Request(scope), error)
    response.headers["Connection"] = "close"
    await response(scope, receive, send)
