"""The user's cache: files that this machine computed and can compute again, each whole, intact and its user's own.

Processes share a folder without locks: an entry appears by renaming, and two that make the same one make it alike.
What is damaged, or belongs to somebody else, counts as absent; what cannot be written only costs time.
"""

from __future__ import annotations

import atexit
import hashlib
import logging
import os
import shutil
import stat
import tempfile
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Final

log = logging.getLogger(__name__)

#: An entry begins with the SHA-256 of the rest.
_DIGEST_BYTES: Final = 32
_LIMIT_BYTES: Final = 2 << 30


def folder(name: str) -> Path:
    """Where things of one kind are kept: `$XDG_CACHE_HOME/graspd/NAME`, by default in `~/.cache`.

    Where that cannot be written it is a folder of the user's own among the temporary files; a log line says so once.
    """
    return _root(os.environ.get("XDG_CACHE_HOME", ""), os.environ.get("HOME", ""), tempfile.gettempdir()) / name


def load(file: Path) -> bytes | None:
    """Content of an entry; None where there is none, it is damaged, or another user wrote it."""
    try:
        with file.open("rb") as opened:
            if os.fstat(opened.fileno()).st_uid != os.geteuid():
                return None
            entry = opened.read()
    except OSError:
        return None
    digest, content = entry[:_DIGEST_BYTES], entry[_DIGEST_BYTES:]
    return content if hashlib.sha256(content).digest() == digest else None


def keep(file: Path, content: bytes, *, limit_bytes: int = _LIMIT_BYTES) -> None:
    """Make or replace an entry; the longest unused of its folder go once that holds more than `limit_bytes`."""
    with suppress(OSError):
        write_whole(file, hashlib.sha256(content).digest() + content)
        make_room(file.parent, file.suffix, limit_bytes, keep=file)


def write_whole(file: Path, content: bytes) -> None:
    """Write a file that others see whole or not at all, and its folder if there is none. Raises OSError."""
    file.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=file.parent, suffix=".part")
    partial = Path(name)
    try:
        with os.fdopen(handle, "wb") as opened:
            opened.write(content)
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def make_room(folder: Path, suffix: str, limit_bytes: int, *, keep: Path) -> None:
    """Remove the longest unused files of a folder but `keep`, until the others hold no more than `limit_bytes`."""
    found = []
    for file in folder.glob(f"*{suffix}"):
        with suppress(FileNotFoundError):
            facts = file.stat()
            found.append((max(facts.st_atime, facts.st_mtime), facts.st_size, file))
    used = 0
    for _, size, file in sorted(found, reverse=True):
        used += size
        if used > limit_bytes and file != keep:
            # A process that has it open goes on reading.
            file.unlink(missing_ok=True)


@lru_cache(maxsize=8)
def _root(xdg: str, home: str, temporary: str) -> Path:
    """The folder of all caches; kept by what it follows from, so that its trouble is told once."""
    try:
        # A relative $XDG_CACHE_HOME counts as unset, as its specification says.
        base = Path(xdg) if Path(xdg).is_absolute() else (Path(home) if home else Path.home()) / ".cache"
        root = base / "graspd"
        root.mkdir(parents=True, exist_ok=True)
        if os.access(root, os.W_OK | os.X_OK):
            return root
        trouble = f"{root} cannot be written"
    except (OSError, RuntimeError) as error:
        trouble = str(error)
    root = _private(Path(temporary))
    log.warning("no cache in the home folder (%s); what can be computed again is kept in %s", trouble, root)
    return root


def _private(temporary: Path) -> Path:
    """A folder that this user alone can write; one that somebody else put in its place is left alone."""
    mine = temporary / f"graspd-cache-{os.geteuid()}"
    with suppress(OSError):
        mine.mkdir(mode=0o700, exist_ok=True)
        facts = mine.lstat()
        if stat.S_ISDIR(facts.st_mode) and facts.st_uid == os.geteuid() and not facts.st_mode & 0o077:
            return mine
    try:
        own = tempfile.mkdtemp(prefix="graspd-cache-", dir=temporary)
    except OSError:
        # Nothing is found there, and nothing is kept.
        return Path(os.devnull)
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return Path(own)
