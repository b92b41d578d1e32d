"""Cache in memory of results for hands and objects; models are compared by content, not by name."""

import inspect
import threading
from collections.abc import Callable, Hashable
from dataclasses import is_dataclass
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np
from cachetools import LRUCache

from graspd.worker.objects.disk_cache import content_digest

P = ParamSpec("P")
T = TypeVar("T")


def cached_by_content(size: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Cache the last `size` results of a function. Concurrent calls wait for each other."""

    def decorate(make: Callable[P, T]) -> Callable[P, T]:
        known: LRUCache[Hashable, T] = LRUCache(size)
        lock, signature = threading.RLock(), inspect.signature(make)

        @wraps(make)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            given = signature.bind(*args, **kwargs)
            given.apply_defaults()
            key = tuple(map(_hashable_content, given.arguments.values()))
            with lock:
                if key not in known:
                    known[key] = make(*args, **kwargs)
                return known[key]

        return call

    return decorate


def _hashable_content(value: Any) -> Hashable:
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if isinstance(value, (list, tuple)):
        return tuple(map(_hashable_content, value))
    if not is_dataclass(value):
        return value
    return getattr(value, "content", None) or content_digest(value)
