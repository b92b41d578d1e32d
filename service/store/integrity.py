"""Checksums of stored objects and of shards in folders; seals inside stored objects.

A seal is the SHA-256 of an object, computed with zeros in place of the seal's 64 digits. It is the first field
`checksum` of a JSON record, the comment of a ZIP or `.npz`, and in the `extras` of a binary glTF. Objects of graspd 0.2
have no seal and are not checked.
"""

import hashlib
import json
import re
import struct
import threading
import time
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from io import BufferedRandom
from itertools import chain
from pathlib import Path
from typing import Any, Final

from graspd.service.model.digests import file_sha256
from graspd.service.model.errors import DamagedError, DamagedShard, NotFoundError
from graspd.service.store.store import STREAM_BYTES, Stamp, Store

#: Checksum list of exports and cards, in the folder of a shard or one of the two folders above; and that of graspd 0.2.
CHECKSUMS: Final = "checksums.sha256"
CHECKSUM_LISTS: Final = (CHECKSUMS, "SHA256SUMS")
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_LEVELS: Final = 3
FIX: Final = "`graspd admin store verify --repair` makes it again where that is possible"
#: Lifetime of a successful check [s], because bits can change without a new modification time.
_BELIEVED_S: Final = 3600.0
_REMEMBERED: Final = 100_000


def read_checked(store: Store, key: str, sha256: str) -> bytes:
    """Read a stored object and verify its checksum; DamagedShard if it is missing or damaged."""
    try:
        data = store.get(key)
    except NotFoundError:
        raise missing_error(key) from None
    check_digest(key, hashlib.sha256(data).hexdigest(), sha256)
    return data


def check_digest(name: str, found: str, expected: str) -> None:
    if found != expected:
        raise DamagedShard(f"{name} is damaged: its SHA-256 is {found[:12]}..., expected {expected[:12]}...; {FIX}")


def checked_chunks(name: str, chunks: Iterable[bytes], expected: str) -> Iterator[bytes]:
    """Yield chunks; DamagedShard after the last one unless they have the expected SHA-256."""
    digest = hashlib.sha256()
    for chunk in chunks:
        digest.update(chunk)
        yield chunk
    check_digest(name, digest.hexdigest(), expected)


def missing_error(key: str) -> DamagedShard:
    return DamagedShard(f"{key} is missing in the store, although its manifest exists; {FIX}")


@dataclass(frozen=True)
class _PassedCheck:
    """Successful check of an object: valid while `stamp` is unchanged, `until` a monotonic time [s]."""

    stamp: Stamp
    until: float
    size: int
    blocks: tuple[bytes, ...]


class CheckedObjects:
    """Cache of checks, valid while size, tag and modification time of an object stay. Thread-safe."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._known: OrderedDict[tuple[str, str], _PassedCheck] = OrderedDict()
        self._lock = threading.Lock()

    def check(self, key: str, sha256: str) -> None:
        """Verify a stored object, unless a recent check exists; DamagedShard if missing or damaged."""
        self._cached_check(key, sha256)

    def stream(self, key: str, sha256: str, start: int, length: int) -> Iterator[bytes]:
        """Yield bytes of a stored object after a new check of each block; may raise DamagedShard."""
        known = self._cached_check(key, sha256)
        end = min(known.size, start + length)
        chunks = self._checked_blocks(key, sha256, known, start, end)
        return chain([first], chunks) if (first := next(chunks, None)) is not None else chunks

    def _checked_blocks(self, key: str, sha256: str, known: _PassedCheck, start: int, end: int) -> Iterator[bytes]:
        for number in range(start // STREAM_BYTES, -(-end // STREAM_BYTES)):
            at = number * STREAM_BYTES
            block = self._store.get_range(key, at, min(STREAM_BYTES, known.size - at))
            if _block_digest(block) != known.blocks[number]:
                with self._lock:
                    self._known.pop((key, sha256), None)
                raise DamagedShard(f"{key} is damaged: some of its bytes changed since it was read; {FIX}")
            yield block[max(0, start - at) : end - at]

    def _cached_check(self, key: str, sha256: str) -> _PassedCheck:
        try:
            stamp = self._store.stamp(key)
            with self._lock:
                known = self._known.get((key, sha256))
            if known is not None and known.stamp == stamp and time.monotonic() < known.until:
                return known
            digest, blocks, size = hashlib.sha256(), list[bytes](), 0
            for chunk in self._store.stream(key):
                digest.update(chunk)
                blocks.append(_block_digest(chunk))
                size += len(chunk)
        except NotFoundError:
            raise missing_error(key) from None
        check_digest(key, digest.hexdigest(), sha256)
        known = _PassedCheck(stamp, time.monotonic() + _BELIEVED_S, size, tuple(blocks))
        with self._lock:
            self._known[key, sha256] = known
            if len(self._known) > _REMEMBERED:
                self._known.popitem(last=False)
        return known


def _block_digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=16).digest()


def check_file(path: Path) -> None:
    """Check a shard in a folder against its manifest or checksum list, once per version of the file."""
    if _known.get(path) != _file_stamp(path):
        check_content(path, _expected_checksum(path))


def check_content(path: Path, sha256: str | None) -> None:
    """Check a file once per version; without `sha256` count it as intact. DamagedShard if it is damaged."""
    stamp = _file_stamp(path)
    if _known.get(path) == stamp:
        return
    if sha256 is not None:
        check_digest(str(path), file_sha256(path), sha256)
    if len(_known) >= _REMEMBERED:
        _known.clear()
    _known[path] = stamp


_known: dict[Path, tuple[int, int, int]] = {}


def _file_stamp(path: Path) -> tuple[int, int, int]:
    facts = path.stat()
    return facts.st_size, facts.st_mtime_ns, facts.st_ino


def _expected_checksum(path: Path) -> str | None:
    path = path.absolute()
    digest = _manifest_checksum(path)
    for sums in (folder / name for folder in list(path.parents)[:_LEVELS] for name in CHECKSUM_LISTS):
        if digest is None and sums.is_file():
            digest = _read_checksum_list(sums, sums.stat().st_mtime_ns).get(str(path.relative_to(sums.parent)))
    return digest


def _manifest_checksum(path: Path) -> str | None:
    """Return the checksum in the manifest next to a file; None if there is none for this file."""
    try:
        manifest = json.loads(path.with_suffix(".json").read_bytes())
        digest = manifest["sha256"] if str(manifest["key"]).endswith(f"/{path.name}") else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return digest if isinstance(digest, str) and _DIGEST.fullmatch(digest) else None


@lru_cache(maxsize=8)
def _read_checksum_list(sums: Path, _changed: int) -> dict[str, str]:
    lines = (line.split(maxsplit=1) for line in sums.read_text(errors="replace").splitlines())
    return {parts[1].removeprefix("*"): parts[0] for parts in lines if len(parts) == 2 and _DIGEST.fullmatch(parts[0])}


_ZEROS: Final = b"0" * 64
_DIGITS: Final = re.compile(rb"[0-9a-f]{64}")
_JSON: Final = b'{"checksum":"'
_GLB: Final = b'{"extras":{"checksum":"'
_ZIP: Final = b"sha256:"
#: Size of the headers of a binary glTF and of its first chunk [bytes].
_GLB_AT: Final = 20
#: Largest number of bytes inserted before a seal with which the seal is still found, and counts as damaged.
_SLACK: Final = 4
_END: Final = struct.Struct("<4s4H2LH")
_END_MARK: Final = b"PK\x05\x06"


def put_sealed(store: Store, key: str, data: bytes) -> bool:
    return store.put(key, add_seal(key, data))


def get_sealed(store: Store, key: str) -> bytes:
    """Read a stored object and verify its seal, if any; DamagedError if the seal does not match."""
    data = store.get(key)
    is_sealed(key, [data], len(data))
    return data


def put_document(store: Store, key: str, document: Mapping[str, Any]) -> bool:
    return put_sealed(store, key, json.dumps(dict(document)).encode())


def get_document(store: Store, key: str) -> dict[str, Any]:
    """Read the JSON object of `put_document`; DamagedError for a wrong seal or other content."""
    try:
        document = json.loads(get_sealed(store, key))
    except ValueError:
        document = None
    if not isinstance(document, dict):
        raise _damage_error(key)
    document.pop("checksum", None)
    return document


def add_seal(key: str, data: bytes) -> bytes:
    """Return the bytes with a seal; other formats than JSON object, ZIP and glTF are unchanged."""
    if key.endswith(".json") and data[:1] == b"{":
        data, at = _JSON + _ZEROS + b'",' + data[1:], len(_JSON)
    elif key.endswith(".glb") and data[:4] == b"glTF" and data[_GLB_AT : _GLB_AT + 1] == b"{":
        data, at = _insert_blank_checksum(data), _GLB_AT + len(_GLB)
    elif key.endswith((".zip", ".npz")) and data[-_END.size : 4 - _END.size] == _END_MARK and data[-2:] == b"\0\0":
        comment = _ZIP + _ZEROS
        data = data[:-2] + struct.pack("<H", len(comment)) + comment
        at = len(data) - len(_ZEROS)
    else:
        return data
    return data[:at] + hashlib.sha256(data).hexdigest().encode() + data[at + len(_ZEROS) :]


def seal_archive(file: BufferedRandom) -> None:
    """Add a seal to an open ZIP without a comment."""
    comment = _ZIP + _ZEROS
    file.seek(-2, 2)
    file.write(struct.pack("<H", len(comment)) + comment)
    file.seek(0)
    digest = hashlib.file_digest(file, "sha256").hexdigest().encode()
    file.seek(-len(_ZEROS), 2)
    file.write(digest)


def is_sealed(key: str, chunks: Iterable[bytes], size: int) -> bool:
    """Check a seal; return False without a seal (graspd 0.2). DamagedError if the seal does not match."""
    is_zip = key.endswith((".zip", ".npz"))
    before, start = (_GLB, _GLB_AT) if key.endswith(".glb") else (_JSON, 0)
    at = size - len(_ZEROS) if is_zip else start + len(before)
    head, tail, read, digest = b"", b"", 0, hashlib.sha256()
    longest = 0 if is_zip else at + len(_ZEROS) + _SLACK
    for chunk in chunks:
        if len(head) < longest:
            head = (head + chunk)[:longest]
        tail = (tail + chunk)[-_END.size - len(_ZIP) - len(_ZEROS) :]
        digest.update(_blank_seal_digits(chunk, at - read))
        read += len(chunk)
    if is_zip:
        found, is_whole = tail[-len(_ZEROS) :], tail[-len(_ZEROS) - len(_ZIP) : -len(_ZEROS)] == _ZIP
        has_none = tail[-_END.size : 4 - _END.size] == _END_MARK and tail[-2:] == b"\0\0"
    else:
        found, is_whole = head[at : at + len(_ZEROS)], head[start:at] == before
        has_none = not is_whole and not _DIGITS.search(head)
    if is_whole and found == digest.hexdigest().encode():
        return True
    if has_none:
        return False
    raise _damage_error(key)


def _damage_error(key: str) -> DamagedError:
    problem = f"{key} in the store is damaged: its bytes do not match its checksum"
    return DamagedError(f"{problem}; put a copy in its place, or run `graspd admin store verify --repair`")


def _blank_seal_digits(chunk: bytes, at: int) -> bytes:
    first, last = max(0, at), min(len(chunk), at + len(_ZEROS))
    return chunk if first >= last else chunk[:first] + _ZEROS[: last - first] + chunk[last:]


def _insert_blank_checksum(data: bytes) -> bytes:
    length = int.from_bytes(data[12:16], "little")
    document = _GLB + _ZEROS + b'"},' + data[_GLB_AT + 1 : _GLB_AT + length]
    document += b" " * (-len(document) % 4)
    rest = data[_GLB_AT + length :]
    head = data[:8] + struct.pack("<2L", _GLB_AT + len(document) + len(rest), len(document)) + data[16:_GLB_AT]
    return head + document + rest
