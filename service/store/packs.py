"""Conversion of packs of graspd 0.2 (many shards in one file) to a file per shard.

A pack has a head (magic bytes and length of the directory), the directory, manifests and files. Its name is the digest
of its directory, which has the SHA-256 of each manifest and file. Other records list the deleted shards of a pack.
"""

import hashlib
import json
import logging
import struct
from collections.abc import Iterator
from typing import Final

from pydantic import Field, ValidationError

from graspd.service.model import names
from graspd.service.model.base import Digest
from graspd.service.model.digests import digest_bytes
from graspd.service.model.errors import DamagedError, NotFoundError
from graspd.service.model.records import Record
from graspd.service.model.states import Stage
from graspd.service.store.manifests import ShardManifest, load_manifest, publish_shard
from graspd.service.store.records import parse_record, put_record
from graspd.service.store.store import Store

log = logging.getLogger(__name__)
PACKED: Final = "packs of graspd 0.2; extract them with `graspd admin store upgrade`"
_FOLDER: Final = "packs"
_MAGIC: Final = b"graspd\x00\x01"
_HEAD: Final = struct.Struct("<8sQ")


class _PackEntry(Record):
    """Positions of a shard's file and manifest after the directory [bytes], with checksums."""

    id: Digest
    stage: Stage
    start: int = Field(ge=0)
    length: int = Field(gt=0)
    sha256: str
    manifest_start: int = Field(ge=0)
    manifest_length: int = Field(gt=0)
    manifest_sha256: str


def has_packs(store: Store) -> bool:
    return next(iter(store.list(_FOLDER)), None) is not None


def convert_packs(store: Store) -> Iterator[ShardManifest]:
    """Replace each pack by a file and a manifest per shard; yield the manifests.

    An interrupted call can be repeated. Damaged packs move to `damaged/`. The manifest of a damaged file is stored,
    so that its replacement must match the checksum.
    """
    keys = store.keys(_FOLDER)
    packs = [key for key in keys if key.endswith(".pack")]
    for pack in packs:
        dead = pack.removesuffix(".pack") + ".dead/"
        yield from _convert_pack(store, pack, [key for key in keys if key.startswith(dead)])
    for key in set(keys) - set(packs):
        store.delete(key)


def _convert_pack(store: Store, key: str, dead: list[str]) -> Iterator[ShardManifest]:
    try:
        data = store.get(key)
        gone = {shard for record in dead for shard in json.loads(store.get(record))["shards"]}
        body, shards = _read_directory(key, data)
    except NotFoundError:
        return  # Another process converted the pack.
    except (DamagedError, ValueError, LookupError, TypeError) as error:
        log.error("the pack %s is damaged, and moved aside: %s", key, error)
        store.set_aside(key)
        return
    whole = True
    for shard in (shard for shard in shards if shard.id not in gone):
        manifest = _checked_piece(data, body + shard.manifest_start, shard.manifest_length, shard.manifest_sha256)
        file = _checked_piece(data, body + shard.start, shard.length, shard.sha256)
        whole = whole and manifest is not None and file is not None
        if manifest is None:
            continue
        record = parse_record(ShardManifest, manifest, f"{shard.id} in the pack {key}")
        record = record.model_copy(update={"key": names.shard_file_key(shard.stage, shard.id)})
        if file is not None:
            publish_shard(store, record, file)
        else:
            put_record(store, names.shard_manifest_key(shard.stage, shard.id), record)
        yield load_manifest(store, shard.stage, shard.id)
    if whole:
        store.delete(key)
    else:
        log.error("the pack %s is partly damaged, and moved aside; run `graspd admin store verify --repair`", key)
        store.set_aside(key)


def _read_directory(key: str, data: bytes) -> tuple[int, list[_PackEntry]]:
    head, rest = data[: _HEAD.size], data[_HEAD.size :]
    magic, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (b"", 0)
    directory = rest[:length]
    if magic != _MAGIC or digest_bytes(directory) != key.rpartition("/")[2].removesuffix(".pack"):
        raise DamagedError("its directory does not match its name")
    try:
        return _HEAD.size + length, [_PackEntry.model_validate(one) for one in json.loads(directory)["shards"]]
    except ValidationError as error:
        raise DamagedError(str(error)) from None


def _checked_piece(data: bytes, start: int, length: int, sha256: str) -> bytes | None:
    piece = data[start : start + length]
    return piece if hashlib.sha256(piece).hexdigest() == sha256 else None
