"""Connections to Redis, whose URL is configured or belongs to the data folder's embedded server."""

import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from redis import Redis
from redis.backoff import ExponentialBackoff
from redis.retry import Retry

from graspd.service.model.errors import QueueUnavailable
from graspd.service.settings import Settings

_SOCKET_TIMEOUT_S: Final = 10.0
_NETWORK: Final = {"socket_connect_timeout": 3.0, "socket_keepalive": True}


def connect(url: str, *, patience: int = 3, timeout_s: float = _SOCKET_TIMEOUT_S) -> Redis:
    """Return a client that reconnects up to `patience` times; each attempt takes at most `timeout_s` [s]."""
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
        # The library's message may contain part of the password.
        raise QueueUnavailable(
            "the Redis URL (GRASPD_REDIS_URL) cannot be used; give redis://, rediss:// or unix://; in a password, "
            "write %2F for /, %23 for #, %3F for ? and %40 for @"
        ) from None


#: Limit of a unix socket's path [bytes], below those of Linux (108 with the final zero) and macOS (104).
_MAX_SOCKET_PATH: Final = 100


def redis_url(settings: Settings) -> str:
    """Return the URL of Redis: GRASPD_REDIS_URL, or the data folder's embedded server."""
    if settings.redis_url is not None:
        return settings.redis_url.get_secret_value()
    secret = password(settings.data_dir)
    return f"unix://{f':{secret}@' if secret else ''}{quote(str(socket_path(settings.data_dir)))}"


def password(data_dir: Path) -> str:
    """Return the password of a data folder's embedded Redis; "" if it has none."""
    try:
        return password_file(data_dir).read_text().strip()
    except OSError:
        return ""


def password_file(data_dir: Path) -> Path:
    return data_dir.resolve() / "redis" / "password"


def socket_path(data_dir: Path) -> Path:
    """Return the socket of a data folder's Redis: in that folder, or if too long in a private one."""
    path = data_dir.resolve() / "redis" / "redis.sock"
    if len(os.fsencode(path)) <= _MAX_SOCKET_PATH:
        return path
    name = hashlib.sha256(os.fsencode(path)).hexdigest()[:16]
    base = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir())
    return base / f"graspd-{os.getuid()}-{name}" / "redis.sock"
