"""A damaged pack is taken apart: each shard gets a file of its own, and what is harmed can be made again by itself."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

from service.model import names
from service.model.errors import DamagedError, NotFoundError
from service.model.states import Stage
from service.pipeline.backends import Parts
from service.pipeline.scrub import STAGES
from service.store.manifests import ShardManifest, described_again
from service.store.packs import pack_at, read_manifests
from service.store.records import put_record


@dataclass(frozen=True)
class _Found:
    """What is left of a shard in a damaged pack."""

    stage: Stage
    shard: str
    manifest: ShardManifest | None
    """None where it is damaged too."""
    data: bytes | None
    """None where they are not what their checksum says."""


def unpack(parts: Parts, key: str) -> list[tuple[Stage, str]]:
    """Put what is intact in a pack as files of their own, and the pack aside; their rows then say so.

    Of a harmed file the manifest alone is put, so that what is made again must have the checksum that it says.

    Returns:
        stage and id of the shards whose files must be made again.

    Raises:
        UnavailableError: a part is away; call it again.
    """
    harmed, moved = [], []
    for found in _left_of(parts, key):
        made = found.manifest
        if made is not None:
            made = made.model_copy(update={"key": names.shard_file(found.stage, found.shard)})
            if found.data is not None:
                parts.store.put(made.key, found.data)
            put_record(parts.store, names.shard_manifest(found.stage, found.shard), made)
            moved.append(made)
        if made is None or found.data is None:
            harmed.append((found.stage, found.shard))
    parts.index.write.add_manifests(moved)
    parts.store.set_aside(key)
    return harmed


def _left_of(parts: Parts, key: str) -> Iterator[_Found]:
    try:
        pack = pack_at(parts.store, key, anew=True)
    except NotFoundError:
        return
    except DamagedError:
        yield from _by_rows(parts, key)
        return
    for shard, made in zip(pack.living, read_manifests(parts.store, pack), strict=True):
        data = _intact(parts, pack.place(shard), shard.sha256)
        manifest = made if isinstance(made, ShardManifest) else _by_row(parts, shard.id, data)
        yield _Found(shard.stage, shard.id, manifest, data)


def _by_rows(parts: Parts, key: str) -> Iterator[_Found]:
    """What the index knows of a pack whose directory cannot be read."""
    for row in parts.index.shards.of_pack(key):
        data = _intact(parts, row.key, row.sha256)
        yield _Found(STAGES[row.kind], row.id, _by_row(parts, row.id, data), data)


def _by_row(parts: Parts, shard: str, data: bytes | None) -> ShardManifest | None:
    """The manifest of a file that is intact: the index has it but for the grasps, which the file tells."""
    try:
        return None if data is None else described_again(parts.index.shards.get(shard).manifest, data)
    except NotFoundError:
        return None


def _intact(parts: Parts, place: str, sha256: str) -> bytes | None:
    try:
        data = parts.store.get(place)
    except NotFoundError:
        return None
    return data if hashlib.sha256(data).hexdigest() == sha256 else None
