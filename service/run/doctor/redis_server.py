"""Redis: whether it answers, takes writes, throws nothing away, and comes back after a crash with what it held."""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from redis import Redis
from redis.exceptions import RedisError

from service.model.errors import QueueUnavailable
from service.model.finding import Finding, bad, good, skipped, warning
from service.queue.connection import connect, redis_url, socket_path
from service.run.embedded import find_server
from service.settings import Settings

#: The oldest that graspd was tried on.
_OLDEST: Final = (6, 2)
_SLOW_S: Final = 0.02
_FULL: Final = 0.9
_TIMEOUT_S: Final = 5.0
_LOCAL: Final = ("127.0.0.1", "localhost", "::1")
_START: Final = "start it, or set GRASPD_REDIS_URL=redis://:PASSWORD@HOST:6379/0"


def is_there(settings: Settings) -> bool:
    """Whether a Redis is named, or the one of `graspd up` may run: False on a machine where nothing was started."""
    return settings.redis_url is not None or socket_path(settings.data_dir).exists()


@contextmanager
def connection(settings: Settings) -> Iterator[Redis]:
    """A client that gives up soon."""
    client = connect(redis_url(settings), patience=0, timeout_s=_TIMEOUT_S)
    try:
        yield client
    finally:
        client.close()


def redis(settings: Settings) -> Finding:
    """The server that `GRASPD_REDIS_URL` or the data folder names."""
    name = "redis"
    if not is_there(settings):
        try:
            _, rung = find_server()
        except QueueUnavailable as error:
            return bad(name, "no service runs on this data folder, and there is no Redis to start", str(error))
        return skipped(name, f"no service runs on this data folder; `graspd up` starts the Redis of {rung}")
    try:
        with connection(settings) as client:
            return _judge(name, settings, client, _info(client))
    except (RedisError, OSError) as error:
        return bad(name, f"{_shown(settings)} does not answer: {_line(error)}", _mend(error, settings))


def _judge(name: str, settings: Settings, client: Redis, info: Mapping[str, Any]) -> Finding:
    version = str(info.get("redis_version", "0"))
    if int(info.get("cluster_enabled", 0)):
        return bad(name, "it is a Redis Cluster: tasks move between keys of several nodes", "name a plain Redis")
    if info.get("role") != "master":
        return bad(name, f"it is a {info.get('role')}: it cannot be written", "name the primary in GRASPD_REDIS_URL")
    most, policy = int(info.get("maxmemory", 0)), str(info.get("maxmemory_policy", "noeviction"))
    if most and policy != "noeviction":
        mend = "redis-cli config set maxmemory-policy noeviction, and the same line in its configuration"
        return bad(
            name, f"maxmemory-policy is {policy}: when memory is full, it throws tasks away without a word", mend
        )
    used = int(info.get("used_memory", 0))
    if most and used > _FULL * most:
        return bad(
            name,
            f"{used >> 20} of {most >> 20} MiB are used",
            "redis-cli config set maxmemory to more; see who else uses it",
        )
    seconds = _write(client)
    line = f"Redis {version} at {_shown(settings)}, {1000 * seconds:.1f} ms, {used >> 20} MiB"
    if tuple(int(part) for part in version.split(".")[:2]) < _OLDEST:
        return warning(
            name, f"{line}: older than 6.2, on which graspd was tried", "install Redis 6.2 or newer, or Valkey"
        )
    if _is_open(settings):
        mend = "requirepass in its configuration, or an ACL, and the password in GRASPD_REDIS_URL"
        return warning(name, f"{line}: it asks for no password, and who writes to it can start tasks", mend)
    if seconds > _SLOW_S:
        return warning(
            name,
            f"{line}: a task takes some 109 operations",
            "put Redis nearer to the workers, or look after the network",
        )
    return good(name, line)


def _write(client: Redis) -> float:
    """Seconds of a write and its reading. Raises RedisError where writes are refused."""
    key, value = f"graspd:doctor:{secrets.token_hex(8)}", secrets.token_bytes(8)
    start = time.perf_counter()
    client.set(key, value, ex=60)
    found = client.get(key)
    seconds = (time.perf_counter() - start) / 2
    client.delete(key)
    if found != value:
        raise RedisError("what was written is not what is read")
    return seconds


def persistence(settings: Settings) -> Finding:
    """Whether a Redis that crashes comes back with its tasks."""
    name = "redis-persistence"
    if not is_there(settings):
        return skipped(name, "no service runs on this data folder; the Redis of `graspd up` keeps a log of writes")
    try:
        with connection(settings) as client:
            info = _info(client)
    except (RedisError, OSError):
        return skipped(name, "Redis does not answer")
    mend = "make room on the disk of Redis and see its log; then redis-cli bgrewriteaof"
    if int(info.get("aof_enabled", 0)):
        for what in ("aof_last_write_status", "aof_last_bgrewrite_status"):
            if info.get(what, "ok") != "ok":
                return bad(name, f"the log of writes fails ({what}: {info[what]})", mend)
        return good(name, "the log of writes is on: a killed Redis comes back with its tasks")
    if info.get("rdb_last_bgsave_status", "ok") != "ok":
        return bad(
            name, "its snapshots fail, and it may refuse writes", "make room on the disk of Redis and see its log"
        )
    return warning(
        name,
        "the log of writes is off: after a crash nothing runs until the controller has queued everything again",
        "redis-cli config set appendonly yes, and `appendonly yes` in its configuration",
    )


def _info(client: Redis) -> dict[str, Any]:
    return dict(client.info())


def _shown(settings: Settings) -> str:
    parts = urlsplit(redis_url(settings))
    if parts.scheme == "unix":
        return unquote(parts.path)
    return f"{parts.scheme}://{parts.hostname}{f':{parts.port}' if parts.port else ''}{parts.path}"


def _is_open(settings: Settings) -> bool:
    """Whether it was reached over a network without a secret."""
    parts = urlsplit(redis_url(settings))
    return parts.scheme != "unix" and parts.hostname not in _LOCAL and not parts.password


def _mend(error: Exception, settings: Settings) -> str:
    said = str(error).upper()
    if "NOAUTH" in said or "WRONGPASS" in said or "AUTHENTICATION" in said:
        return "put the password into GRASPD_REDIS_URL: redis://:PASSWORD@HOST:6379/0"
    if "MISCONF" in said or "OOM" in said:
        return "it cannot write: make room on its disk or in its memory, and see its log"
    if settings.redis_url is None:
        return "the service of this data folder ended without a word: start `graspd up` again"
    return _START


def _line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
