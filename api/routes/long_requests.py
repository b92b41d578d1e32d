"""Threads of their own for requests that take long, so that those which wait for one keep no other request waiting."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import Any, Final, TypeVar

from anyio import CapacityLimiter, to_thread

from service.model.errors import UnavailableError

T = TypeVar("T")
#: Uploads that are unpacked and packed at once; each may hold one file of its size in memory.
UPLOADS: Final = 4
#: Forms with an upload: they wait for its check too.
FORMS: Final = 8
#: Files of chosen grasps that are written at once.
EXPORTS: Final = 2
_WAITING: Final = 32
_PATIENCE_S: Final = 20.0


class Turns:
    """A bounded number of threads, and of requests that wait for one.

    Args:
        at_once: threads.
        waiting: requests that may wait.
        patience_s: how long each of these waits [s].
    """

    def __init__(self, at_once: int, *, waiting: int = _WAITING, patience_s: float = _PATIENCE_S) -> None:
        self._free = asyncio.Semaphore(at_once)
        self._threads = CapacityLimiter(at_once)
        self._waiting = 0
        self._most_waiting = waiting
        self._patience_s = patience_s

    async def run(self, function: Callable[..., T], *args: Any, **options: Any) -> T:
        """What the function answers, in a thread of these.

        Raises:
            UnavailableError: too many wait already, or no turn came in time.
        """
        await self._take()
        try:
            return await to_thread.run_sync(partial(function, *args, **options), limiter=self._threads)
        finally:
            self._free.release()

    async def _take(self) -> None:
        busy = UnavailableError("too many requests of this kind at once; try again in a moment")
        if self._free.locked() and self._waiting >= self._most_waiting:
            raise busy
        self._waiting += 1
        try:
            async with asyncio.timeout(self._patience_s):
                await self._free.acquire()
        except TimeoutError:
            raise busy from None
        finally:
            self._waiting -= 1
