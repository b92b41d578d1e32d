"""How often and how many at once: one script in Redis counts for all API processes together.

Rates follow GCRA (ITU-T I.371 annex A), a leaky bucket that keeps one number a caller: the time at which the bucket is
empty again. Requests being answered are a sorted set by the time until which each is believed to run, so that those of
a killed process count no longer than that. Redis's own clock is asked, so the clocks of the API machines do not matter.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from dataclasses import dataclass
from typing import Any, Final

from redis.asyncio import Redis
from redis.exceptions import RedisError

log = logging.getLogger(__name__)
WINDOW_S: Final = 60
#: A request that gives no sign for this long is no longer counted as being answered [s].
HELD_S: Final = 60.0
_ANSWER_S: Final = 0.5
#: After a failure Redis is left alone for this long [s]: a limit is not worth making every request wait.
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
    """What a caller may use; 0: no limit."""

    per_minute: int
    concurrency: int


@dataclass(frozen=True)
class Admission:
    """Whether a request may be answered. `refused` names the limit it met: rate, concurrency, or nothing."""

    refused: str
    remaining: int
    seconds: float
    """Until the full allowance is there again, or if refused, until another try makes sense."""


class Rates:
    """The counters of all callers. Where Redis is away everybody may enter: the limits guard, they do not decide."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._client: Any = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._silent_until = 0.0

    async def enter(self, caller: str, allowance: Allowance, request: str) -> Admission | None:
        """Count a request in; None where nothing is limited or Redis does not answer."""
        if allowance.per_minute <= 0 and allowance.concurrency <= 0:
            return None
        arguments = (allowance.per_minute, WINDOW_S, allowance.concurrency, request, HELD_S)
        reply = await self._run(_ENTER, _keys(caller), arguments)
        if reply is None:
            return None
        refused, remaining, seconds = (part.decode() for part in reply)
        return Admission(refused, int(remaining), float(seconds))

    async def keep(self, caller: str, request: str) -> None:
        """Say that a long request is still being answered."""
        await self._run(_KEEP, _keys(caller)[1:], (request, HELD_S))

    async def leave(self, caller: str, request: str) -> None:
        """Count a request out."""
        await self._run("redis.call('ZREM', KEYS[1], ARGV[1])", _keys(caller)[1:], (request,))

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
            log.warning("limits are not counted while Redis does not answer: %s", error)
            return None

    def _connect(self) -> Any:
        loop = asyncio.get_running_loop()
        if self._client is None or self._loop is not loop:
            self._client = Redis.from_url(self._url, socket_timeout=_ANSWER_S, socket_connect_timeout=_ANSWER_S)
            self._loop = loop
        return self._client


def seconds_up(seconds: float) -> int:
    """Whole seconds, at least one: what Retry-After takes."""
    return max(1, math.ceil(seconds))


def _keys(caller: str) -> tuple[str, str]:
    return f"graspd:rate:{caller}", f"graspd:held:{caller}"
