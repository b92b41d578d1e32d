"""Seals: the SHA-256 that an object of the store carries in itself, so that any byte that turned is found.

A seal is the digest of the object with the 64 digits of the seal as zeros. A JSON record has it as its first field
`checksum`, a ZIP (`.npz` too) in its comment, a binary glTF in the `extras` of its document. Objects of graspd 0.2 have
none, and are read as before.
"""

from __future__ import annotations

import hashlib
import json
import re
import struct
from collections.abc import Iterable, Mapping
from io import BufferedRandom
from typing import Any, Final

from service.model.errors import DamagedError
from service.store.store import Store

_ZEROS: Final = b"0" * 64
_DIGITS: Final = re.compile(rb"[0-9a-f]{64}")
_JSON: Final = b'{"checksum":"'
_GLB: Final = b'{"extras":{"checksum":"'
_ZIP: Final = b"sha256:"
#: A document's header and the header of its first chunk [bytes].
_GLB_AT: Final = 20
#: Head of an object in which digits would stand if some bytes before them were lost or added [bytes].
_SLACK: Final = 4
_END: Final = struct.Struct("<4s4H2LH")
_END_MARK: Final = b"PK\x05\x06"


def put_sealed(store: Store, key: str, data: bytes) -> bool:
    """Write an object with its seal, if there is none of this name; False if there was."""
    return store.put(key, sealed(key, data))


def get_sealed(store: Store, key: str) -> bytes:
    """An object that is what its seal says, or has none.

    Raises:
        NotFoundError: there is no such object.
        DamagedError: its bytes are not those that were sealed.
    """
    data = store.get(key)
    is_sealed(key, [data], len(data))
    return data


def put_document(store: Store, key: str, document: Mapping[str, Any]) -> bool:
    """Write JSON with its seal, if there is none of this name."""
    return put_sealed(store, key, json.dumps(dict(document)).encode())


def get_document(store: Store, key: str) -> dict[str, Any]:
    """The JSON of `put_document`; errors as of `get_sealed`, DamagedError also where it is no JSON object."""
    try:
        found = json.loads(get_sealed(store, key))
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise _damaged(key)
    found.pop("checksum", None)
    return found


def sealed(key: str, data: bytes) -> bytes:
    """The object with its seal. What is no JSON object, ZIP or glTF stays as it is."""
    if key.endswith(".json") and data[:1] == b"{":
        data, at = _JSON + _ZEROS + b'",' + data[1:], len(_JSON)
    elif key.endswith(".glb") and data[:4] == b"glTF" and data[_GLB_AT : _GLB_AT + 1] == b"{":
        data, at = _with_extras(data), _GLB_AT + len(_GLB)
    elif key.endswith((".zip", ".npz")) and data[-_END.size : 4 - _END.size] == _END_MARK and data[-2:] == b"\0\0":
        comment = _ZIP + _ZEROS
        data = data[:-2] + struct.pack("<H", len(comment)) + comment
        at = len(data) - len(_ZEROS)
    else:
        return data
    return data[:at] + hashlib.sha256(data).hexdigest().encode() + data[at + len(_ZEROS) :]


def seal_archive(file: BufferedRandom) -> None:
    """Seal a ZIP in a file that is open for reading and writing."""
    comment = _ZIP + _ZEROS
    file.seek(-2, 2)
    file.write(struct.pack("<H", len(comment)) + comment)
    file.seek(0)
    digest = hashlib.file_digest(file, "sha256").hexdigest().encode()
    file.seek(-len(_ZEROS), 2)
    file.write(digest)


def is_sealed(key: str, chunks: Iterable[bytes], size: int) -> bool:
    """Whether an object has a seal, which then holds; False where graspd 0.2 wrote it without one.

    Args:
        key: its name, whose ending tells its format.
        chunks: its bytes.
        size: their number.

    Raises:
        DamagedError: its bytes are not those that were sealed.
    """
    is_zip = key.endswith((".zip", ".npz"))
    before, start = (_GLB, _GLB_AT) if key.endswith(".glb") else (_JSON, 0)
    at = size - len(_ZEROS) if is_zip else start + len(before)
    head, tail, read, digest = b"", b"", 0, hashlib.sha256()
    longest = 0 if is_zip else at + len(_ZEROS) + _SLACK
    for chunk in chunks:
        if len(head) < longest:
            head = (head + chunk)[:longest]
        tail = (tail + chunk)[-_END.size - len(_ZIP) - len(_ZEROS) :]
        digest.update(_without_digits(chunk, at - read))
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
    raise _damaged(key)


def _damaged(key: str) -> DamagedError:
    return DamagedError(
        f"{key} in the store is damaged: its bytes are not those of its checksum; put a copy in its place, or run "
        "`graspd admin store verify --repair`"
    )


def _without_digits(chunk: bytes, at: int) -> bytes:
    """A chunk with the digits, which begin `at` its start, as zeros."""
    first, last = max(0, at), min(len(chunk), at + len(_ZEROS))
    return chunk if first >= last else chunk[:first] + b"0" * (last - first) + chunk[last:]


def _with_extras(data: bytes) -> bytes:
    """A binary glTF whose document begins with room for the seal."""
    length = int.from_bytes(data[12:16], "little")
    document = _GLB + _ZEROS + b'"},' + data[_GLB_AT + 1 : _GLB_AT + length]
    document += b" " * (-len(document) % 4)
    rest = data[_GLB_AT + length :]
    head = data[:8] + struct.pack("<2L", _GLB_AT + len(document) + len(rest), len(document)) + data[16:_GLB_AT]
    return head + document + rest
