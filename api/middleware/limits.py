"""Limits of requests: rate and concurrency for each caller; size and duration of bodies.

Rates follow GCRA (ITU-T I.371 annex A), a leaky bucket. One number is stored per caller: the time at which the bucket
is empty again. Requests in progress form a sorted set of expiry times, so that requests of a killed process expire.
All times come from Redis's clock.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
import uuid
from dataclasses import dataclass
from typing import Any, Final

from redis.asyncio import Redis
from redis.exceptions import RedisError
from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from graspd.api.access.auth import Proxy, authenticate, authorize
from graspd.api.access.auth import caller as present_caller
from graspd.api.access.keys import Key, KeyFile
from graspd.api.access.keys import Scope as KeyScope
from graspd.api.middleware.request_context import SAFE_METHODS, HttpMiddleware
from graspd.api.problems import ApiError, error_response
from graspd.service.model.errors import LimitError
from graspd.service.settings import Settings
from graspd.service.telemetry import bind_subjects

#: Paths without limits: they are cheap, and browsers and monitoring poll them often.
_FREE: Final = ("/static/", "/healthz", "/readyz")


class RateLimit(HttpMiddleware):
    """Stores the key of a request in `scope["state"]["key"]` and enforces the limits of that key.

    A request without a key counts against its address. While there are no keys, there are no limits. Responses have
    the headers RateLimit and RateLimit-Policy (draft-ietf-httpapi-ratelimit-headers-10).
    """

    def __init__(self, app: ASGIApp, *, keys: KeyFile, proxy: Proxy, settings: Settings, rates: Rates) -> None:
        super().__init__(app)
        self.keys = keys
        self.proxy = proxy
        self.settings = settings
        self.rates = rates

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        is_open = self.keys.is_open
        key = scope.setdefault("state", {})["key"] = None if is_open else authenticate(scope, self.keys, self.proxy)
        token = present_caller.set(key)
        try:
            with bind_subjects(key=key.name if key else ""):
                if is_open or scope["path"].startswith(_FREE):
                    await self.app(scope, receive, send)
                else:
                    await self._enforce_limits(scope, receive, send, key)
        finally:
            present_caller.reset(token)

    async def _enforce_limits(self, scope: Scope, receive: Receive, send: Send, key: Key | None) -> None:
        request = Request(scope)
        name = f"key:{key.name}" if key else f"address:{request.client.host if request.client else ''}"
        allowance = _allowance_of(key, self.settings)
        # A caller could send many requests with the same id, so that they would count as one.
        number = uuid.uuid4().hex
        admission = await self.rates.enter(name, allowance, number)
        if admission is None:
            await self.app(scope, receive, send)
            return
        headers = _rate_limit_headers(allowance, admission)
        if admission.refused:
            await error_response(request, _refusal(admission, allowance, headers))(scope, receive, send)
            return
        kept = time.monotonic()

        async def counted(message: Message) -> None:
            nonlocal kept
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(headers)
            elif time.monotonic() - kept > HELD_S / 3:
                # A long response renews the request's entry.
                kept = time.monotonic()
                await self.rates.renew(name, number)
            await send(message)

        try:
            await self.app(scope, receive, counted)
        finally:
            if allowance.concurrency:
                await self.rates.leave(name, number)


def _allowance_of(key: Key | None, settings: Settings) -> Allowance:
    if key is None:
        return Allowance(settings.address_requests_per_minute, settings.concurrency)
    own = key.limits
    return Allowance(
        settings.requests_per_minute if own.requests_per_minute is None else own.requests_per_minute,
        settings.concurrency if own.concurrency is None else own.concurrency,
    )


def _rate_limit_headers(allowance: Allowance, admission: Admission) -> dict[str, str]:
    if not allowance.per_minute:
        return {}
    return {
        "RateLimit-Policy": f'"requests";q={allowance.per_minute};w={WINDOW_S}',
        "RateLimit": f'"requests";r={admission.remaining};t={_whole_seconds(admission.seconds)}',
    }


def _refusal(admission: Admission, allowance: Allowance, headers: dict[str, str]) -> ApiError:
    wait = _whole_seconds(admission.seconds)
    if admission.refused == "concurrency":
        reason, headers = f"{allowance.concurrency} of your requests are in progress, the maximum at once", {}
    else:
        reason = f"more than {allowance.per_minute} requests in a minute"
    return ApiError(429, f"{reason}; try again in {wait} s", headers=headers | {"Retry-After": str(wait)})


log = logging.getLogger(__name__)
WINDOW_S: Final = 60
#: Time without renewal [s] after which a request no longer counts as in progress.
HELD_S: Final = 60.0
_ANSWER_S: Final = 0.5
#: Time without limits after a failure of Redis [s]; otherwise each request would wait for Redis.
_PAUSE_S: Final = 1.0

_ENTER: Final = """
local time = redis.call('TIME')
local now = tonumber(time[1]) + tonumber(time[2]) / 1000000
local rate, window, concurrency = tonumber(ARGV[1]), tonumber(ARGV[2]), tonumber(ARGV[3])
local held = tonumber(ARGV[5])
if concurrency > 0 then
  redis.call('ZREMRANGEBYSCORE', KEYS[2], '-inf', now)
  if redis.call('ZCARD', KEYS[2]) >= concurrency then return {'concurrency', '0', '1'} end
end
local remaining, reset = 0, 0
if rate > 0 then
  local step = window / rate
  local empty = tonumber(redis.call('GET', KEYS[1]) or now)
  -- A clock that was set back must not shut anybody out for longer than a window.
  empty = math.min(math.max(empty, now), now + window)
  if empty + step > now + window + 0.000001 then
    return {'rate', '0', string.format('%.6f', empty + step - now - window)}
  end
  empty = empty + step
  redis.call('SET', KEYS[1], string.format('%.6f', empty), 'PX', math.ceil((empty - now) * 1000) + 1000)
  remaining = math.floor((now + window - empty) / step + 0.000001)
  reset = empty - now
end
if concurrency > 0 then
  redis.call('ZADD', KEYS[2], now + held, ARGV[4])
  redis.call('PEXPIRE', KEYS[2], math.ceil(held * 1000))
end
return {'', tostring(remaining), string.format('%.6f', reset)}
"""

_KEEP: Final = """
local time = redis.call('TIME')
redis.call('ZADD', KEYS[1], 'XX', tonumber(time[1]) + tonumber(ARGV[2]), ARGV[1])
redis.call('PEXPIRE', KEYS[1], math.ceil(tonumber(ARGV[2]) * 1000))
"""


@dataclass(frozen=True)
class Allowance:
    per_minute: int
    concurrency: int


@dataclass(frozen=True)
class Admission:
    """Decision on a request. `refused` is the exceeded limit, rate or concurrency; empty if admitted."""

    refused: str
    remaining: int
    seconds: float
    """Time until the full allowance is available again; for a refused request, until a retry can succeed."""


class Rates:
    """Counters of all callers in Redis; without Redis, every request is admitted."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._client: Any = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._silent_until = 0.0

    async def enter(self, caller: str, allowance: Allowance, request: str) -> Admission | None:
        """Count a new request; None if there is no limit or Redis does not answer."""
        if allowance.per_minute <= 0 and allowance.concurrency <= 0:
            return None
        arguments = (allowance.per_minute, WINDOW_S, allowance.concurrency, request, HELD_S)
        reply = await self._run(_ENTER, (f"graspd:rate:{caller}", f"graspd:held:{caller}"), arguments)
        if reply is None:
            return None
        refused, remaining, seconds = (part.decode() for part in reply)
        return Admission(refused, int(remaining), float(seconds))

    async def renew(self, caller: str, request: str) -> None:
        await self._run(_KEEP, (f"graspd:held:{caller}",), (request, HELD_S))

    async def leave(self, caller: str, request: str) -> None:
        await self._run("redis.call('ZREM', KEYS[1], ARGV[1])", (f"graspd:held:{caller}",), (request,))

    async def close(self) -> None:
        if self._client is not None and self._loop is asyncio.get_running_loop():
            await self._client.aclose()
        self._client = None

    async def _run(self, script: str, keys: tuple[str, ...], arguments: tuple[Any, ...]) -> Any:
        if time.monotonic() < self._silent_until:
            return None
        try:
            return await self._connect().eval(script, len(keys), *keys, *arguments)
        except (RedisError, OSError, TimeoutError) as error:
            self._silent_until = time.monotonic() + _PAUSE_S
            log.warning("requests are not limited while Redis does not answer: %s", error)
            return None

    def _connect(self) -> Any:
        loop = asyncio.get_running_loop()
        if self._client is None or self._loop is not loop:
            self._client = Redis.from_url(self._url, socket_timeout=_ANSWER_S, socket_connect_timeout=_ANSWER_S)
            self._loop = loop
        return self._client


def _whole_seconds(seconds: float) -> int:
    return max(1, math.ceil(seconds))


#: Size limit of a JSON body or a form without a file; job requests take a few hundred bytes.
MAX_BODY_BYTES: Final = 1 << 20
PIECE_S: Final = 30.0
#: Least transfer rate of a body [bytes/s].
LEAST_BYTES_S: Final = 16 << 10
_FORM_SLACK_BYTES: Final = 64 << 10
#: Maximum number of digits of a Content-Length; Python parses thousands of digits slowly, or refuses them.
_MOST_DIGITS: Final = 18


class BodyLimit(HttpMiddleware):
    """Refuses bodies whose Content-Length exceeds the limit; aborts bodies that become too long or slow."""

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
        if (refusal := _body_refusal(scope, limit, is_upload=is_upload)) is not None:
            await _refuse(refusal, scope, receive, send)
        else:
            await self._enforce_limit(scope, receive, send, limit)

    async def _enforce_limit(self, scope: Scope, receive: Receive, send: Send, limit: int) -> None:
        received, began = 0, time.monotonic()
        is_whole = is_answered = False
        refusal: Exception | None = None

        async def counted() -> Message:
            nonlocal received, is_whole, refusal
            try:
                # After the body only a disconnect can arrive, and the response may take any time.
                async with asyncio.timeout(None if is_whole else self.piece_s):
                    message = await receive()
            except TimeoutError:
                refusal = ApiError(408, f"no part of the body arrived for {self.piece_s:g} s; send it again")
                return {"type": "http.disconnect"}
            is_whole = not message.get("more_body", False)
            received += len(message.get("body", b""))
            late = time.monotonic() - began - self.piece_s
            if not is_whole and received < late * LEAST_BYTES_S:
                refusal = ApiError(408, f"the body arrives at less than {LEAST_BYTES_S >> 10} KiB/s; send it again")
                return {"type": "http.disconnect"}
            if received > limit:
                refusal = _too_large(limit)
                # Simulates a disconnect, so that the application stops; its response is replaced below.
                return {"type": "http.disconnect"}
            return message

        async def send_once(message: Message) -> None:
            nonlocal is_answered
            if refusal is not None and not is_answered:
                return
            is_answered = True
            await send(message)

        await self.app(scope, counted, send_once)
        if refusal is not None and not is_answered:
            await _refuse(refusal, scope, receive, send)


def _body_refusal(scope: Scope, limit: int, *, is_upload: bool) -> Exception | None:
    """Return the reason to refuse a body before it is read; None if there is no reason."""
    given = dict(scope["headers"])
    if b"transfer-encoding" in given and b"content-length" in given:
        # With two lengths, a proxy may use the other one, and the rest would be parsed as the next request.
        return ApiError(400, "Transfer-Encoding and Content-Length exclude each other")
    encoding = given.get(b"content-encoding", b"").decode("latin-1").strip().lower()
    if encoding not in ("", "identity") and scope["method"] not in SAFE_METHODS:
        problem = f"the body has Content-Encoding {encoding[:40]!r}; send an unencoded body"
        return ApiError(415, problem, headers={"Accept-Encoding": "identity"})
    declared = given.get(b"content-length", b"0")
    if not declared.isdigit() or len(declared) > _MOST_DIGITS or int(declared) > limit:
        return _too_large(limit)
    if declared != b"0" or b"transfer-encoding" in given:
        try:
            if is_upload or scope["path"].startswith("/v1/"):
                authorize(Request(scope), KeyScope.SUBMIT if is_upload else KeyScope.READ)
        except ApiError as error:
            return error
    return None


def _too_large(limit: int) -> LimitError:
    return LimitError(f"the body is larger than {limit} bytes; send a smaller one")


async def _refuse(error: Exception, scope: Scope, receive: Receive, send: Send) -> None:
    response = error_response(Request(scope), error)
    response.headers["Connection"] = "close"
    await response(scope, receive, send)
