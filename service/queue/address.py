"""Where Redis answers: the one of the settings, or the embedded one of the data folder."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path
from typing import Final
from urllib.parse import quote

from service.settings import Settings

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
