"""Cache in memory of what follows from a hand or an object: models are compared by their content, not their name."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np
from cachetools import LRUCache
from cachetools.keys import hashkey

P = ParamSpec("P")
T = TypeVar("T")


def cached_by_content(size: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Cache the last `size` results of a function; its calls wait for each other."""

    def decorate(make: Callable[P, T]) -> Callable[P, T]:
        known: LRUCache[Hashable, T] = LRUCache(size)
        lock = threading.RLock()

        @wraps(make)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            key = hashkey(*map(_content, args), **{name: _content(value) for name, value in kwargs.items()})
            with lock:
                if key not in known:
                    known[key] = make(*args, **kwargs)
                return known[key]

        return call

    return decorate


def _content(value: object) -> object:
    return value.tobytes() if isinstance(value, np.ndarray) else getattr(value, "content", value)
