"""Where Redis answers, the one of the settings or the embedded one of the data folder, and a connection to it."""

from __future__ import annotations

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


#: Longest path of a unix socket that Linux (108 bytes with the final zero) and macOS (104) both take.
_MAX_SOCKET_PATH: Final = 100


def redis_url(settings: Settings) -> str:
    """The Redis of these settings: GRASPD_REDIS_URL, or else the one that `graspd up` starts for the data folder."""
    if settings.redis_url is not None:
        return settings.redis_url.get_secret_value()
    secret = password(settings.data_dir)
    return f"unix://{f':{secret}@' if secret else ''}{quote(str(socket_path(settings.data_dir)))}"


def password(data_dir: Path) -> str:
    """What the embedded Redis of a data folder asks for; "" if it listens on its private socket alone."""
    try:
        return password_file(data_dir).read_text().strip()
    except OSError:
        return ""


def password_file(data_dir: Path) -> Path:
    """Where the password of an embedded Redis is kept, readable by its user alone."""
    return data_dir.resolve() / "redis" / "password"


def socket_path(data_dir: Path) -> Path:
    """Where the embedded Redis of a data folder listens: inside it, or where that path is too long, in a private
    folder that follows from it."""
    path = data_dir.resolve() / "redis" / "redis.sock"
    if len(os.fsencode(path)) <= _MAX_SOCKET_PATH:
        return path
    name = hashlib.sha256(os.fsencode(path)).hexdigest()[:16]
    base = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir())
    return base / f"graspd-{os.getuid()}-{name}" / "redis.sock"
