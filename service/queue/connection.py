"""A connection to Redis, without the queue: what a small process needs that must start quickly."""

from __future__ import annotations

from typing import Any, Final

from redis import Redis
from redis.backoff import ExponentialBackoff
from redis.retry import Retry

from service.model.errors import QueueUnavailable

_SOCKET_TIMEOUT_S: Final = 10.0
_NETWORK: Final = {"socket_connect_timeout": 3.0, "socket_keepalive": True}


def connect(url: str, *, patience: int = 3, timeout_s: float = _SOCKET_TIMEOUT_S) -> Redis:
    """A client that reconnects by itself.

    Args:
        patience: how often it tries before it gives up.
        timeout_s: longest wait for one answer [s].
    """
    over_network: dict[str, Any] = {} if url.startswith("unix:") else _NETWORK
    try:
        return Redis.from_url(
            url,
            **over_network,
            socket_timeout=timeout_s,
            health_check_interval=30,
            retry=Retry(ExponentialBackoff(cap=1.0, base=0.05), patience),
        )
    except (ValueError, TypeError):
        # What the library says may hold a part of the password.
        raise QueueUnavailable(
            "the Redis URL (GRASPD_REDIS_URL) cannot be used; give redis://, rediss:// or unix://, and in a password "
            "%2F for /, %23 for #, %3F for ? and %40 for @"
        ) from None
