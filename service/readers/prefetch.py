"""Samples read ahead: threads unpack the next ones while the last one is worked on."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from service.model.errors import InputError


def prefetched(
    source: Sequence[dict[str, Any]], order: Iterable[int] | None = None, *, workers: int = 2, ahead: int = 8
) -> Iterator[dict[str, Any]]:
    """Samples of `Pictures`, `Clouds` or `Grasps`, in the stated order, each the same as `source[i]`.

    Reading and unpacking pictures leaves the interpreter to others, so that threads share the work; from a store they
    wait for the network at the same time.

    Args:
        source: the samples.
        order: their indices; by default all in turn.
        workers: threads.
        ahead: how many samples are held that nobody took yet: so much memory.

    Raises:
        InputError: a number is less than one.
        and what reading a sample raises, when it is its turn.
    """
    if workers < 1 or ahead < 1:
        raise InputError(f"reading ahead takes at least one thread and one sample; got {workers} and {ahead}")
    return _read(source, iter(range(len(source)) if order is None else order), workers, ahead)


def _read(source: Sequence[dict[str, Any]], order: Iterator[int], workers: int, ahead: int) -> Iterator[dict[str, Any]]:
    waiting: deque[Future[dict[str, Any]]] = deque()
    pool = ThreadPoolExecutor(workers, thread_name_prefix="prefetch")
    try:
        for index in order:
            waiting.append(pool.submit(source.__getitem__, index))
            if len(waiting) > ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
