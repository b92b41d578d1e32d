"""The user's cache of reproducible files, each complete, verified and private.

Processes share a folder without locks: writes are atomic, and two writers of one entry write equal content. Damaged or
foreign entries count as absent; a failed write only costs time.
"""

import hashlib
import logging
import os
import stat
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Final

log = logging.getLogger(__name__)

_DIGEST_BYTES: Final = 32
_LIMIT_BYTES: Final = 2 << 30


def cache_folder(name: str) -> Path:
    """Return the folder of one kind of entries, in `$XDG_CACHE_HOME/graspd`, else a private temporary one."""
    return _cache_root(os.environ.get("XDG_CACHE_HOME", ""), os.environ.get("HOME", ""), tempfile.gettempdir()) / name


def load(file: Path) -> bytes | None:
    """Load the content of an entry; None if it is absent, damaged, or written by another user."""
    try:
        with file.open("rb") as opened:
            if os.fstat(opened.fileno()).st_uid != os.geteuid():
                return None
            entry = opened.read()
    except OSError:
        return None
    digest, content = entry[:_DIGEST_BYTES], entry[_DIGEST_BYTES:]
    return content if hashlib.sha256(content).digest() == digest else None


def store(file: Path, content: bytes, *, limit_bytes: int = _LIMIT_BYTES) -> None:
    """Write an entry with its SHA-256; evict the least recently used entries beyond `limit_bytes`."""
    with suppress(OSError):
        write_atomically(file, [hashlib.sha256(content).digest(), content])
        evict(file.parent, file.suffix, limit_bytes, keep=file)


def write_atomically(file: Path, pieces: Iterable[bytes]) -> None:
    """Create the folder and write a file atomically, private to this user; no file if `pieces` raises."""
    file.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=file.parent, suffix=".part")
    partial = Path(name)
    try:
        with os.fdopen(handle, "wb") as opened:
            opened.writelines(pieces)
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def evict(folder: Path, suffix: str, limit_bytes: int, *, keep: Path) -> None:
    """Remove the least recently used files of a folder, except `keep`, beyond `limit_bytes` in total."""
    found = []
    for file in folder.glob(f"*{suffix}"):
        with suppress(FileNotFoundError):
            facts = file.stat()
            found.append((max(facts.st_atime, facts.st_mtime), facts.st_size, file))
    used = 0
    for _, size, file in sorted(found, reverse=True):
        used += size
        if used > limit_bytes and file != keep:
            # Processes that have opened the file can still read it.
            file.unlink(missing_ok=True)


@lru_cache(maxsize=8)
def _cache_root(xdg: str, home: str, temporary: str) -> Path:
    """Return the root of all caches; the cache of results logs a problem only once."""
    try:
        # By specification, a relative $XDG_CACHE_HOME counts as unset.
        base = Path(xdg) if Path(xdg).is_absolute() else (Path(home) if home else Path.home()) / ".cache"
        root = base / "graspd"
        root.mkdir(parents=True, exist_ok=True)
        if os.access(root, os.W_OK | os.X_OK):
            return root
        problem = f"{root} cannot be written"
    except (OSError, RuntimeError) as error:
        problem = str(error)
    root = _private_folder(Path(temporary))
    log.warning("no cache in the home folder (%s); reproducible files are in %s", problem, root)
    return root


def _private_folder(temporary: Path) -> Path:
    """Create a private folder; return `/dev/null` if another user owns the path."""
    mine = temporary / f"graspd-cache-{os.geteuid()}"
    with suppress(OSError):
        mine.mkdir(mode=0o700, exist_ok=True)
        facts = mine.lstat()
        if stat.S_ISDIR(facts.st_mode) and facts.st_uid == os.geteuid() and not facts.st_mode & 0o077:
            return mine
    return Path(os.devnull)
