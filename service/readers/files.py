"""Shards of local files, or of a job or snapshot in a store, with a cache of downloaded files."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from graspd.service.model import names
from graspd.service.model.errors import DamagedShard, InputError, NotFoundError
from graspd.service.model.planning import plan_tasks
from graspd.service.model.records import JobRecord
from graspd.service.store.columns import SCHEMAS, ShardKind
from graspd.service.store.integrity import check_content, check_file, checked_chunks, missing_error
from graspd.service.store.manifests import load_manifest
from graspd.service.store.packs import PACKED, has_packs
from graspd.service.store.records import newest_snapshot, read_record
from graspd.service.store.shards import open_shard, shard_kind
from graspd.service.store.store import Store, open_store
from graspd.service.user_cache import cache_folder, evict, write_atomically

DEFAULT_BYTES: Final = 20 << 30


@dataclass(frozen=True)
class ShardFile:
    """Shard in a local file (`path`) or in a store (`key`)."""

    id: str
    kind: ShardKind
    hand: str
    object: str
    batch: int
    path: Path | None = None
    key: str = ""
    sha256: str = ""


class ShardCache:
    """Cache of a store's files, named by SHA-256 and verified on download. Processes may share a folder."""

    def __init__(self, folder: Path, *, limit_bytes: int = DEFAULT_BYTES) -> None:
        self.folder, self.limit_bytes, self._process = folder, limit_bytes, os.getpid()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"the cache folder {folder} cannot be made: {error.strerror}") from None

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _process=os.getpid())

    def fetch(self, store: Store, key: str, sha256: str) -> Path:
        """Return the path of the cached file, downloaded if needed; DamagedShard if missing or damaged."""
        path = self.folder / f"{sha256}.h5"
        if not self._is_intact(path, sha256):
            write_atomically(path, self._download(store, key, sha256))
            evict(self.folder, path.suffix, self.limit_bytes, keep=path)
        return path

    @staticmethod
    def _is_intact(path: Path, sha256: str) -> bool:
        try:
            check_content(path, sha256)
            # A new access time marks the file as recently used; the old modification time marks it as verified.
            os.utime(path, ns=(time.time_ns(), path.stat().st_mtime_ns))
        except (FileNotFoundError, DamagedShard):
            return False
        return True

    def _download(self, store: Store, key: str, sha256: str) -> Iterator[bytes]:
        # In a fork, requests to a remote store never return.
        if os.getpid() != self._process and not store.url.startswith(("file:", "memory:")):
            fix = "start new processes: DataLoader(..., multiprocessing_context='spawn')"
            raise InputError(f"{store.url} cannot be read in a fork of the process that opened it; {fix}")
        try:
            yield from checked_chunks(f"{store.url}/{key}", store.stream(key), sha256)
        except NotFoundError:
            raise missing_error(f"{store.url}/{key}") from None


@dataclass(frozen=True)
class Shards:
    """Shards of a dataset, ordered by hand, object, batch and id."""

    files: tuple[ShardFile, ...]
    store: Store | None = None
    cache: ShardCache | None = None

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[ShardFile]:
        return iter(self.files)

    @cached_property
    def _by_id(self) -> dict[str, ShardFile]:
        return {file.id: file for file in self.files}

    def of_kind(self, kind: str) -> tuple[ShardFile, ...]:
        return tuple(file for file in self.files if file.kind == kind)

    def by_id(self, shard: str) -> ShardFile:
        """Return a shard by its id; NotFoundError if the id is not among these shards."""
        if shard not in self._by_id:
            raise NotFoundError(f"shard {shard[:12]} is not among the {len(self)} shards given")
        return self._by_id[shard]

    def select(self, *, hands: Iterable[str] = (), objects: Iterable[str] = ()) -> Shards:
        """Select the shards of some hands and objects, by default of all."""
        of_hands, of_objects = set(hands), set(objects)
        found = [file for file in self.files if not of_hands or file.hand in of_hands]
        found = [file for file in found if not of_objects or file.object in of_objects]
        return replace(self, files=tuple(found))

    def path(self, file: ShardFile) -> Path:
        """Return the path of the local or downloaded file; DamagedShard if it is damaged."""
        if file.path is not None:
            check_file(file.path)
            return file.path
        assert self.store is not None and self.cache is not None, "a shard without a path comes from a store"
        return self.cache.fetch(self.store, file.key, file.sha256)


def open_shards(
    source: str | Path | Store | Iterable[str | Path],
    *,
    job: str | None = None,
    dataset: str | None = None,
    snapshot: str | None = None,
    cache: Path | None = None,
    cache_bytes: int = DEFAULT_BYTES,
) -> Shards:
    """Find the shards of a folder (searched recursively), of files, or of a job or dataset in a store.

    Args:
        source: one or several folders and files, or a store or its URL (`file://`, `s3://`, `gs://`, `az://`).
        job: id of a job in the store, for its finished shards.
        dataset: name of a dataset in the store, for the shards of its newest snapshot.
        snapshot: digest of another snapshot of the dataset.
        cache: folder for files of a store; by default `$XDG_CACHE_HOME/graspd/shards`.
        cache_bytes: size limit of the cache [bytes].

    Raises:
        NotFoundError: no such file, job, dataset or snapshot.
        InputError: a store without job or dataset, or a file that is not a shard.
        DamagedShard: a file of a folder does not match its checksum.
        StoreUnavailable: the store does not answer.
    """
    if isinstance(source, Store) or (isinstance(source, str) and "://" in source):
        store = source if isinstance(source, Store) else open_store(source, make=False)
        found = _sort_files(_shards_of_store(store, job, dataset, snapshot))
        return Shards(found, store, ShardCache(cache or cache_folder("shards"), limit_bytes=cache_bytes))
    given = [source] if isinstance(source, str | Path) else list(source)
    return Shards(_sort_files(_shard_file(path) for entry in given for path in _shard_paths(Path(entry))))


def _shard_paths(entry: Path) -> list[Path]:
    if entry.is_dir():
        found = sorted(entry.rglob("*.h5"))
        if any(entry.rglob("*.pack")):
            raise InputError(f"{entry} has shards in {PACKED}")
        if not found:
            raise NotFoundError(f"{entry} contains no .h5 file")
        return found
    if not entry.is_file():
        raise NotFoundError(f"{entry} does not exist")
    return [entry]


def _shard_file(path: Path) -> ShardFile:
    with open_shard(path) as file:
        kind, attributes = shard_kind(file, str(path)), dict(file.attrs)
    name = str(attributes.get("shard_id", path.resolve()))
    hand, obj = (str(attributes.get(key, "")) for key in ("hand", "object"))
    return ShardFile(name, kind, hand, obj, int(attributes.get("batch", 0)), path=path)


def _shards_of_store(store: Store, job: str | None, dataset: str | None, snapshot: str | None) -> Iterator[ShardFile]:
    if (job is None) == (dataset is None):
        raise InputError(f"name the data to read from {store.url}: a job or a dataset")
    if has_packs(store):
        raise InputError(f"{store.url} has shards in {PACKED}")
    if job is not None:
        return _shards_of_job(store, job)
    assert dataset is not None
    return _shards_of_snapshot(store, dataset, snapshot)


def _shards_of_job(store: Store, job: str) -> Iterator[ShardFile]:
    record = read_record(JobRecord, store, names.job_record_key(job))
    for task in plan_tasks(record):
        try:
            made = load_manifest(store, task.stage, task.output)
        except NotFoundError:
            continue
        yield ShardFile(made.shard_id, made.kind, made.hand, made.object, made.batch, key=made.key, sha256=made.sha256)


def _shards_of_snapshot(store: Store, dataset: str, digest: str | None) -> Iterator[ShardFile]:
    for shard in newest_snapshot(store, dataset, digest).shards:
        yield ShardFile(shard.id, shard.kind, shard.hand, shard.object, shard.batch, key=shard.key, sha256=shard.sha256)


def _sort_files(files: Iterable[ShardFile]) -> tuple[ShardFile, ...]:
    order = list(SCHEMAS)
    return tuple(sorted(files, key=lambda file: (file.hand, file.object, file.batch, order.index(file.kind), file.id)))
