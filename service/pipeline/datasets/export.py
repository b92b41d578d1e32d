"""Export of a snapshot as files in a folder, with verified checksums; existing files are skipped."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from graspd.service.cli import write_output
from graspd.service.model.digests import file_sha256
from graspd.service.model.errors import InputError
from graspd.service.model.records import Snapshot, SnapshotShard
from graspd.service.store.integrity import CHECKSUMS, checked_chunks

#: Function that yields the bytes of a shard in chunks, from the API or from the store.
Fetch = Callable[[SnapshotShard], Iterable[bytes]]
#: Called after each file with the numbers of finished files, of all files, and of fetched bytes.
Progress = Callable[[int, int, int], None]
_CHUNK: Final = 1 << 20


def export_shards(snapshot: Snapshot, folder: Path, fetch: Fetch, progress: Progress | None = None) -> int:
    """Export shards, then `checksums.sha256` and `snapshot.json`; return the number of fetched shards.

    Files are `HAND/OBJECT/KIND-BATCH.h5`. DamagedShard: a checksum differs from that in the snapshot.
    """
    _make_folder(folder)
    fetched = size = 0
    for number, shard in enumerate(snapshot.shards, start=1):
        path = folder / path_of(shard)
        if not _is_exported(path, shard):
            _make_folder(path.parent)
            write_output(path, checked_chunks(f"shard {shard.id}", fetch(shard), shard.sha256))
            fetched, size = fetched + 1, size + shard.size_bytes
        if progress is not None:
            progress(number, len(snapshot.shards), size)
    sums = "".join(f"{shard.sha256}  {path_of(shard)}\n" for shard in snapshot.shards)
    (folder / CHECKSUMS).write_text(sums)
    (folder / "snapshot.json").write_text(snapshot.model_dump_json(indent=1) + "\n")
    return fetched


def path_of(shard: SnapshotShard) -> str:
    return f"{shard.hand}/{shard.object}/{shard.kind}-{shard.batch:05}.h5"


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder {folder} cannot be made: {error.strerror}") from None


def _is_exported(path: Path, shard: SnapshotShard) -> bool:
    if not path.is_file() or path.stat().st_size != shard.size_bytes:
        return False
    return file_sha256(path) == shard.sha256
