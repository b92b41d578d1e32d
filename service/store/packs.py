"""Shard packs: shards that ended together, with their manifests, in one immutable object.

A pack is a head, a directory, the manifests, the files (byte layout: docs/dataset.md). Its name follows from its
directory, and the directory has the SHA-256 of each manifest and file: the name vouches for every byte. A shard of a
pack is gone once a record beside the pack says so; the pack itself goes with the last of them.
"""

from __future__ import annotations

import hashlib
import logging
import struct
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from service.model import names
from service.model.digests import digest_bytes
from service.model.domain import Digest
from service.model.errors import DamagedError, NotFoundError
from service.model.states import Stage
from service.store.integrity import MEND, read_checked
from service.store.manifests import ShardManifest, load_manifest
from service.store.parts import Part, part_of
from service.store.records import parse_record, read_record
from service.store.shards import Shard, read_shard
from service.store.store import Store

log = logging.getLogger(__name__)
MAGIC: Final = b"graspd\x00\x01"
_HEAD: Final = struct.Struct("<8sQ")
#: More than the directory of the largest pack takes [bytes].
_LONGEST: Final = 1 << 26
_REMEMBERED: Final = 200
#: Head and directory of some two hundred shards [bytes].
_FIRST_READ: Final = 1 << 16
#: More than a store takes as one object [bytes].
_LARGEST: Final = 10**14


class PackedShard(BaseModel):
    """Where a shard's file and its manifest lie behind the directory of a pack [bytes], and what they must be."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    id: Digest
    stage: Stage
    start: int = Field(ge=0, lt=_LARGEST)
    length: int = Field(gt=0, lt=_LARGEST)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    manifest_start: int = Field(ge=0, lt=_LARGEST)
    manifest_length: int = Field(gt=0, lt=_LARGEST)
    manifest_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class Directory(BaseModel):
    """What is in a pack."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    version: Literal[1] = 1
    shards: tuple[PackedShard, ...] = Field(min_length=1)


class DeadShards(BaseModel):
    """Shards of a pack that are gone, since no job needs them any more."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    version: Literal[1] = 1
    shards: tuple[Digest, ...]


@dataclass(frozen=True)
class Pack:
    """A pack of the store."""

    key: str
    body: int
    """Where the first manifest begins [bytes]."""
    shards: tuple[PackedShard, ...]
    dead: frozenset[str] = frozenset()
    """Shards of it that are gone."""

    @property
    def living(self) -> tuple[PackedShard, ...]:
        """Those that are there."""
        return tuple(shard for shard in self.shards if shard.id not in self.dead)

    def place(self, shard: PackedShard) -> str:
        """Where a shard's file lies, as its manifest has it."""
        return str(Part(self.key, self.body + shard.start, shard.length))

    def place_of_manifest(self, shard: PackedShard) -> str:
        """Where its manifest lies."""
        return str(Part(self.key, self.body + shard.manifest_start, shard.manifest_length))


def put_pack(store: Store, shards: Sequence[tuple[ShardManifest, bytes]]) -> str:
    """Put shards of one hand and one object as one object of the store; returns its key."""
    manifests = [manifest.model_copy(update={"key": ""}).model_dump_json().encode() for manifest, _ in shards]
    files = [data for _, data in shards]
    starts = list(accumulate(map(len, (*manifests, *files)), initial=0))
    rows = [
        PackedShard(
            id=made.shard_id,
            stage=made.stage,
            start=starts[len(shards) + row],
            length=len(data),
            sha256=made.sha256,
            manifest_start=starts[row],
            manifest_length=len(manifests[row]),
            manifest_sha256=hashlib.sha256(manifests[row]).hexdigest(),
        )
        for row, (made, data) in enumerate(shards)
    ]
    directory = Directory(shards=tuple(rows)).model_dump_json().encode()
    made = shards[0][0]
    key = names.pack(names.packs_of(made.hand_digest, made.object_digest), digest_bytes(directory))
    store.put(key, b"".join([_HEAD.pack(MAGIC, len(directory)), directory, *manifests, *files]))
    return key


def read_pack(store: Store, key: str, *, dead: Collection[str] = (), anew: bool = False) -> Pack:
    """The directory of a pack, checked against its name.

    Args:
        dead: keys of the records that say which of its shards are gone.
        anew: read it though it was read before.

    Raises:
        NotFoundError: there is no such pack.
        DamagedError: it is not what its name says, or one of the records is none.
    """
    if anew or (known := _known.get(key)) is None:
        known = _read_directory(store, key)
        if len(_known) >= _REMEMBERED:
            _known.clear()
        _known[key] = known
    gone = [shard for record in dead for shard in read_record(DeadShards, store, record).shards]
    return replace(known, dead=frozenset(gone)) if gone else known


#: A pack's name follows from its directory, whatever store it lies in.
_known: dict[str, Pack] = {}


def _read_directory(store: Store, key: str) -> Pack:
    first = store.get(str(Part(key, 0, _FIRST_READ)))
    head, data = first[: _HEAD.size], first[_HEAD.size :]
    magic, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (b"", 0)
    if magic != MAGIC or length > _LONGEST:
        length = 0
    if length > len(data):
        data += store.get(str(Part(key, len(first), length - len(data))))
    data = data[:length]
    if not data or digest_bytes(data) != key.rpartition("/")[2].removesuffix(".pack"):
        raise DamagedError(f"the directory of the pack {key} is damaged; {MEND}")
    return Pack(key, _HEAD.size + length, parse_record(Directory, data, key).shards)


def pack_at(store: Store, key: str, *, anew: bool = False) -> Pack:
    """A pack with what became of its shards; arguments and errors are those of `read_pack`."""
    return read_pack(store, key, dead=[entry.key for entry in store.list(names.pack_dead(key))], anew=anew)


def read_manifests(store: Store, pack: Pack) -> list[ShardManifest | DamagedError]:
    """The manifests of the shards of a pack that are there, read in one go; the error in place of one that is damaged.

    Raises:
        NotFoundError: the pack is gone.
    """
    length = max(shard.manifest_start + shard.manifest_length for shard in pack.shards)
    data = store.get(str(Part(pack.key, pack.body, length)))
    found: list[ShardManifest | DamagedError] = []
    for shard in pack.living:
        try:
            end = shard.manifest_start + shard.manifest_length
            found.append(_manifest(pack, shard, data[shard.manifest_start : end]))
        except DamagedError as error:
            found.append(error)
    return found


def read_manifest(store: Store, pack: Pack, shard: PackedShard) -> ShardManifest:
    """The manifest of one shard of a pack.

    Raises:
        NotFoundError: the pack is gone.
        DamagedError: it is not what the directory says.
    """
    return _manifest(pack, shard, store.get(pack.place_of_manifest(shard)))


def _manifest(pack: Pack, shard: PackedShard, data: bytes) -> ShardManifest:
    name = f"{shard.id} in the pack {pack.key}"
    if hashlib.sha256(data).hexdigest() != shard.manifest_sha256:
        raise DamagedError(f"the manifest of {name} is damaged; {MEND}")
    made = parse_record(ShardManifest, data, name)
    return made.model_copy(update={"key": pack.place(shard)})


def packs_below(store: Store, folder: str = names.PACKS) -> Iterator[tuple[str, Pack | DamagedError]]:
    """The packs of a hand and an object, or all of them, by name, with the error in place of one that is damaged."""
    packs, dead = list[str](), defaultdict[str, list[str]](list)
    for entry in store.list(folder):
        if entry.key.endswith(".pack"):
            packs.append(entry.key)
        else:
            dead[entry.key.rpartition("/")[0]].append(entry.key)
    for key in sorted(packs):
        try:
            yield key, read_pack(store, key, dead=dead[names.pack_dead(key)])
        except NotFoundError:
            continue  # removed since it was listed
        except DamagedError as error:
            yield key, error


class Finder:
    """Finds manifests wherever they lie; lists the packs of a hand and an object once."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._packed: dict[str, dict[str, tuple[Pack, PackedShard]]] = {}

    def manifest(self, stage: Stage, shard: str, pair: tuple[str, str]) -> ShardManifest | None:
        """The manifest of a shard, in a file of its own or else in a pack; None while there is no such shard.

        Args:
            pair: digests of its hand and its object.

        Raises:
            DamagedError: it is damaged.
            StoreUnavailable: the store does not answer.
        """
        try:
            return load_manifest(self._store, stage, shard)
        except NotFoundError:
            pass
        folder = names.packs_of(*pair)
        if folder not in self._packed:
            self._packed[folder] = self._below(folder)
        found = self._packed[folder].get(shard)
        try:
            return None if found is None else read_manifest(self._store, *found)
        except NotFoundError:
            return None

    def _below(self, folder: str) -> dict[str, tuple[Pack, PackedShard]]:
        found: dict[str, tuple[Pack, PackedShard]] = {}
        for _, pack in packs_below(self._store, folder):
            if isinstance(pack, DamagedError):
                log.warning("%s", pack)  # its shards may lie elsewhere too
                continue
            for shard in pack.living:
                found.setdefault(shard.id, (pack, shard))
        return found


def find_manifest(store: Store, stage: Stage, shard: str, pair: tuple[str, str]) -> ShardManifest | None:
    """See `Finder.manifest`."""
    return Finder(store).manifest(stage, shard, pair)


def find_shard(store: Store, stage: Stage, shard: str, pair: tuple[str, str]) -> Shard:
    """A finished shard, in a file of its own or in a pack, checked against its manifest.

    Raises:
        NotFoundError: there is no such shard.
        DamagedShard: its file is gone, or not what the manifest says.
    """
    if (made := find_manifest(store, stage, shard, pair)) is None:
        raise NotFoundError(f"there is no shard {shard!r} in the store")
    return read_shard(read_checked(store, made.key, made.sha256), kind=made.kind, name=made.key)


def manifest_at(store: Store, place: str, stage: Stage, shard: str) -> ShardManifest:
    """The manifest of a shard whose file lies at a place; NotFoundError where it is not there any more."""
    if (part := part_of(place)) is None:
        return load_manifest(store, stage, shard)
    pack = read_pack(store, part.key)
    found = next((one for one in pack.shards if one.id == shard), None)
    if found is None:
        raise NotFoundError(f"there is no shard {shard!r} in the pack {part.key}")
    return read_manifest(store, pack, found)
