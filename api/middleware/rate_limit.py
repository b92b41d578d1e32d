"""Rate-limit middleware: identifies the caller and enforces limits before anything of the request is read."""

from __future__ import annotations

import time
import uuid
from typing import Final

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.access.auth import caller as present_caller
from api.access.auth import identify
from api.access.keys import Key, KeyFile
from api.access.proxy import Proxy
from api.middleware.rates import HELD_S, WINDOW_S, Admission, Allowance, Rates, seconds_up
from api.problems import ApiError, answer
from service.logs import bind
from service.settings import Settings

#: What costs nothing and is asked often, by browsers and by whatever watches the service.
_FREE: Final = ("/static/", "/healthz", "/readyz")


class RateLimit:
    """Finds the key of a request (`scope["state"]["key"]`) and counts the request against the limits of that key.

    A request without a key counts against its address. An open service serves one machine and counts nothing.

    Refusals are 429 with Retry-After; every counted answer carries RateLimit and RateLimit-Policy
    (draft-ietf-httpapi-ratelimit-headers-10).
    """

    def __init__(self, app: ASGIApp, *, keys: KeyFile, proxy: Proxy, settings: Settings, rates: Rates) -> None:
        self.app = app
        self.keys = keys
        self.proxy = proxy
        self.settings = settings
        self.rates = rates

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        is_open = self.keys.is_open
        key = scope.setdefault("state", {})["key"] = None if is_open else identify(scope, self.keys, self.proxy)
        token = present_caller.set(key)
        try:
            with bind(key=key.name if key else ""):
                if is_open or scope["path"].startswith(_FREE):
                    await self.app(scope, receive, send)
                else:
                    await self._count(scope, receive, send, key)
        finally:
            present_caller.reset(token)

    async def _count(self, scope: Scope, receive: Receive, send: Send, key: Key | None) -> None:
        request = Request(scope)
        name = f"key:{key.name}" if key else f"address:{request.client.host if request.client else ''}"
        allowance = allowance_of(key, self.settings)
        # Not the request's id: a caller may choose that, and so count many requests as one.
        number = uuid.uuid4().hex
        admission = await self.rates.enter(name, allowance, number)
        if admission is None:
            await self.app(scope, receive, send)
            return
        headers = _headers(allowance, admission)
        if admission.refused:
            await answer(request, _refusal(admission, allowance, headers))(scope, receive, send)
            return
        try:
            await self.app(scope, receive, _Told(self.rates, name, number, headers, send))
        finally:
            if allowance.concurrency:
                await self.rates.leave(name, number)


class _Told:
    """Sends on, with the headers at the start; while a long answer flows it goes on counting as being answered."""

    def __init__(self, rates: Rates, name: str, number: str, headers: dict[str, str], send: Send) -> None:
        self.rates = rates
        self.name = name
        self.number = number
        self.headers = headers
        self.send = send
        self.kept = time.monotonic()

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).update(self.headers)
        elif time.monotonic() - self.kept > HELD_S / 3:
            self.kept = time.monotonic()
            await self.rates.keep(self.name, self.number)
        await self.send(message)


def allowance_of(key: Key | None, settings: Settings) -> Allowance:
    """Limits of a key, or of an address that shows none."""
    if key is None:
        return Allowance(settings.address_requests_per_minute, settings.concurrency)
    own = key.limits
    return Allowance(
        settings.requests_per_minute if own.requests_per_minute is None else own.requests_per_minute,
        settings.concurrency if own.concurrency is None else own.concurrency,
    )


def _headers(allowance: Allowance, admission: Admission) -> dict[str, str]:
    if not allowance.per_minute:
        return {}
    return {
        "RateLimit-Policy": f'"requests";q={allowance.per_minute};w={WINDOW_S}',
        "RateLimit": f'"requests";r={admission.remaining};t={seconds_up(admission.seconds)}',
    }


def _refusal(admission: Admission, allowance: Allowance, headers: dict[str, str]) -> ApiError:
    wait = seconds_up(admission.seconds)
    if admission.refused == "concurrency":
        reason = f"{allowance.concurrency} of your requests are being answered, and more at once are not"
        headers = {}
    else:
        reason = f"more than {allowance.per_minute} requests in a minute"
    return ApiError(429, f"{reason}; try again in {wait} s", headers=headers | {"Retry-After": str(wait)})
