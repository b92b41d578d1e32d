"""Cache of remote shards, verified on download and bounded in size."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from graspd.service.model.errors import DamagedShard, InputError, NotFoundError
from graspd.service.store.integrity import check_content, check_digest, gone
from graspd.service.store.store import Store
from graspd.service.user_cache import make_room, write_whole

DEFAULT_BYTES: Final = 20 << 30


class ShardCache:
    """Files of a store, named by their SHA-256. Processes may share a folder: writes are atomic."""

    def __init__(self, folder: Path, *, limit_bytes: int = DEFAULT_BYTES) -> None:
        self.folder, self.limit_bytes, self._process = folder, limit_bytes, os.getpid()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"the cache folder {folder} cannot be made: {error.strerror}") from None

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _process=os.getpid())

    def fetch(self, store: Store, key: str, sha256: str) -> Path:
        """Return the local path of a file of the store, downloaded if necessary; DamagedShard if missing or damaged."""
        path = self.folder / f"{sha256}.h5"
        if not self._is_intact(path, sha256):
            write_whole(path, self._checked(store, key, sha256))
            make_room(self.folder, path.suffix, self.limit_bytes, keep=path)
        return path

    @staticmethod
    def _is_intact(path: Path, sha256: str) -> bool:
        try:
            check_content(path, sha256)
            facts = path.stat()
            # Mark the file as recently used. Its modification time is unchanged, because it marks the file as verified.
            os.utime(path, ns=(time.time_ns(), facts.st_mtime_ns))
        except (FileNotFoundError, DamagedShard):
            return False
        return True

    def _checked(self, store: Store, key: str, sha256: str) -> Iterator[bytes]:
        # Requests to a remote store would never return in a fork.
        if os.getpid() != self._process and not store.url.startswith(("file:", "memory:")):
            raise InputError(
                f"{store.url} cannot be read in a fork of the process that opened it; "
                "start the processes anew: DataLoader(..., multiprocessing_context='spawn')"
            )
        digest = hashlib.sha256()
        try:
            for chunk in store.stream(key):
                digest.update(chunk)
                yield chunk
        except NotFoundError:
            raise gone(f"{store.url}/{key}") from None
        check_digest(f"{store.url}/{key}", digest.hexdigest(), sha256)
