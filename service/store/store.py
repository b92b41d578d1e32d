"""Object store: create-only writes of immutable objects; folder, S3, Google Cloud, Azure or memory.

Operations are put if absent, get, range, list, move and delete; compare-and-swap is not needed.
"""

import errno
import io
import os
import random
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import IO, Any, Final
from urllib.parse import unquote, urlsplit

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError
from obstore.store import LocalStore, MemoryStore, from_url

from graspd.service.model.base import first_line
from graspd.service.model.errors import InputError, NotFoundError, StoreUnavailable

_KEY: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._=-]*(/[A-Za-z0-9][A-Za-z0-9._=-]*)*")
_PROBE: Final = "health/probe"
STREAM_BYTES: Final = 1 << 20
#: Timeouts and retries of requests to remote stores.
_REMOTE: Final[dict[str, Any]] = {
    "client_options": {"timeout": timedelta(seconds=120), "connect_timeout": timedelta(seconds=5)},
    "retry_config": {"max_retries": 3, "retry_timeout": timedelta(seconds=30)},
}


@dataclass(frozen=True)
class Entry:
    key: str
    size: int


#: Size, modification time and tag ("" if none) of a stored object; a change of the object changes the stamp.
Stamp = tuple[int, str, str]


class Store:
    """Objects by key. Every method raises StoreUnavailable if the store does not answer."""

    def __init__(self, backend: Any, url: str, *, signer: Any = None) -> None:
        """`signer` is the backend with its address for clients; None if clients have no access."""
        self._backend = backend
        self._signer = signer
        self.url = url
        self._root = Path(backend.prefix) if isinstance(backend, LocalStore) and backend.prefix is not None else None

    def put(self, key: str, data: bytes) -> bool:
        """Write an object atomically; return False, without a change, if the key exists."""
        return self.put_file(key, io.BytesIO(data))

    def put_file(self, key: str, file: IO[bytes]) -> bool:
        """Write an open file like `put`; a local store copies the file in pieces."""
        check_key(key)
        file.seek(0)
        with _convert_errors(key, self.url):
            if self._root is not None:
                return _put_local(self._root, key, file)
            try:
                obstore.put(self._backend, key, file.read(), mode="create")
            except AlreadyExistsError:
                return False
            return True

    def delete(self, key: str) -> None:
        with suppress(NotFoundError), _convert_errors(key, self.url):
            obstore.delete(self._backend, check_key(key))

    def get(self, key: str) -> bytes:
        with _convert_errors(key, self.url):
            return bytes(obstore.get(self._backend, check_key(key)).bytes())

    def get_range(self, key: str, start: int, length: int) -> bytes:
        with _convert_errors(key, self.url):
            return bytes(obstore.get_range(self._backend, check_key(key), start=start, length=length))

    def stream(self, key: str, start: int = 0, length: int | None = None) -> Iterator[bytes]:
        """Yield chunks of an object from byte `start` on; at most one chunk is in memory."""
        end = self.size(key) if length is None else start + length
        while start < end:
            if not (chunk := self.get_range(key, start, min(STREAM_BYTES, end - start))):
                return
            start += len(chunk)
            yield chunk

    def size(self, key: str) -> int:
        with _convert_errors(key, self.url):
            return int(obstore.head(self._backend, check_key(key))["size"])

    def set_aside(self, key: str) -> None:
        self.move(key, f"damaged/{key}")

    def move(self, key: str, to: str) -> None:
        with suppress(NotFoundError), _convert_errors(key, self.url):
            obstore.rename(self._backend, check_key(key), check_key(to), overwrite=True)

    def stamp(self, key: str) -> Stamp:
        """Return the stamp of an object; NotFoundError if the object does not exist."""
        with _convert_errors(key, self.url):
            meta = obstore.head(self._backend, check_key(key))
            return int(meta["size"]), meta["last_modified"].isoformat(), str(meta.get("e_tag") or "")

    def exists(self, key: str) -> bool:
        try:
            self.size(key)
        except NotFoundError:
            return False
        return True

    def list(self, prefix: str, *, offset: str | None = None) -> Iterator[Entry]:
        """Yield objects below a folder in arbitrary order; with `offset`, only keys that sort after it."""
        with _convert_errors(prefix, self.url):
            for batch in obstore.list(self._backend, check_key(prefix), offset=offset):
                yield from (Entry(str(meta["path"]), int(meta["size"])) for meta in batch)

    def keys(self, prefix: str) -> Sequence[str]:
        return sorted(entry.key for entry in self.list(prefix))

    def sign(self, key: str, *, seconds: int = 3600) -> str | None:
        """Return a temporary URL for reading the object without credentials; None if unsupported."""
        check_key(key)
        if self._signer is None:
            return None
        try:
            return str(obstore.sign(self._signer, "GET", key, timedelta(seconds=seconds)))
        except (BaseError, ValueError, TypeError, NotImplementedError, OSError):
            # The credentials can read but not sign; the API serves the file instead.
            return None

    def probe(self) -> float:
        """Return the duration of a small write [s]; StoreUnavailable if the store is not writable."""
        start = time.perf_counter()
        with _convert_errors(_PROBE, self.url):
            obstore.put(self._backend, _PROBE, b"1", mode="overwrite")
        return time.perf_counter() - start


def open_store(url: str, *, public_endpoint: str | None = None, make: bool = True) -> Store:
    """Open the store of a URL: `file:///folder`, `memory://`, `s3://`, `gs://`, `az://`.

    Remote stores take credentials and endpoints from the usual variables (AWS_ACCESS_KEY_ID, ...).

    Args:
        public_endpoint: S3 endpoint for clients. Without it, AWS_ENDPOINT_URL counts as internal to the network of the
            service: the API serves files, because downloads are not signed.
        make: create a missing folder. Readers do not, because an empty folder would hide a mistyped path.

    Raises InputError for an unknown scheme, NotFoundError for a missing folder, StoreUnavailable.
    """
    parts = urlsplit(url)
    if parts.scheme == "memory":
        return Store(MemoryStore(), url)
    if (folder := local_folder(url)) is not None:
        if not make and not folder.is_dir():
            raise NotFoundError(f"there is no store at {folder}; set GRASPD_DATA_DIR, or GRASPD_STORE_URL")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if not os.access(folder, os.W_OK | os.X_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            return Store(LocalStore(folder), url)
        except (OSError, BaseError) as error:
            raise StoreUnavailable(f"the store folder {folder} cannot be written: {_error_line(error)}") from None
    if parts.scheme not in ("s3", "gs", "az"):
        raise InputError(f"the store URL {url!r} names no known store; use file://, s3://, gs:// or az://")
    with _convert_errors(url, url):
        own = os.environ.get("AWS_ENDPOINT_URL") or os.environ.get("AWS_ENDPOINT") or None
        endpoint = own if parts.scheme == "s3" else None
        backend: Any = from_url(url, **_remote_options(endpoint))
        signer: Any = None if endpoint else backend
        if public_endpoint and parts.scheme == "s3":
            signer = from_url(url, **_remote_options(public_endpoint), endpoint=public_endpoint)
        return Store(backend, url, signer=signer)


def local_folder(url: str) -> Path | None:
    """Return the folder of a local store, else None; InputError for a relative path or bad characters."""
    parts = urlsplit(url)
    if parts.scheme != "file":
        return None
    if parts.netloc or not parts.path.startswith("/"):
        raise InputError(f"the store URL {url!r} must contain an absolute path: file:///absolute/folder")
    if "?" in url or "#" in url or not url.isprintable():
        raise InputError(f"the store URL {url!r} has a special character; write %3F for ?, %23 for #, %0A for newline")
    return Path(unquote(parts.path))


def check_key(key: str) -> str:
    if not _KEY.fullmatch(key) or ".." in key:
        raise InputError(f"{key!r} is no name of an object in the store")
    return key


def _remote_options(endpoint: str | None) -> dict[str, Any]:
    options: dict[str, Any] = {key: dict(value) for key, value in _REMOTE.items()}
    if endpoint is not None and endpoint.startswith("http://"):
        options["client_options"]["allow_http"] = True
    return options


def _put_local(root: Path, key: str, data: IO[bytes]) -> bool:
    """Write a file, flush it to disk, then link it to its name: atomic even at a power failure."""
    path = root / key
    if path.exists():
        return False
    made = [folder for folder in path.parents if root in folder.parents and not folder.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    # obstore does not list names that end in `#` and digits, which its own unfinished writes have.
    staged = path.with_name(f"{path.name}#{random.SystemRandom().randrange(10**12)}")
    try:
        with staged.open("wb") as file:
            shutil.copyfileobj(data, file, STREAM_BYTES)
            file.flush()
            os.fsync(file.fileno())
        os.link(staged, path)
    except FileExistsError:
        return False
    finally:
        staged.unlink(missing_ok=True)
    for folder in {path.parent, *(folder.parent for folder in made)}:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    return True


@contextmanager
def _convert_errors(key: str, url: str) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise NotFoundError(f"there is no object {key!r} in the store") from None
    except (BaseError, OSError) as error:
        raise StoreUnavailable(f"the store {url} does not answer or cannot be written: {_error_line(error)}") from None


def _error_line(error: Exception) -> str:
    return getattr(error, "strerror", None) or first_line(error)
