"""The shards of a dataset one after the other, with no more of each than a card needs. Pictures are not fetched."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.model import names
from service.model.errors import NotFoundError
from service.model.metrics import GRASP_METRICS
from service.readers import ShardFile
from service.store import validity
from service.store.manifests import ShardManifest, load_manifest
from service.store.shards import json_attribute, open_shard, read_column
from worker.cards.contents import Contents

#: Columns of which a card is made; those that a shard lacks are left out.
COLUMNS: Final[dict[str, tuple[str, ...]]] = {
    "base": (
        "grasp/hand_pose",
        "grasp/joint_positions",
        "quality/thresholds_m",
        *(metric.path for metric in GRASP_METRICS),
        *validity.COLUMNS,
        "quality/audit",
        "quality/lift_hard",
    ),
    "scene": ("grasp/base_index", "grasp/hand_pose", "grasp/valid", "grasp/rejection", "scene/object_pose"),
    "views": (),
}
_STAGES: Final = {kind: stage for stage, kind in names.SHARD_KINDS.items()}
_AT_ONCE: Final = 64
_THREADS: Final = 8


@dataclass(frozen=True)
class Piece:
    """One shard: its columns, and what its attributes and its manifest say of it."""

    file: ShardFile
    columns: Mapping[str, NDArray[Any]]
    said: Mapping[str, Any]
    """Root attributes; of a shard that was not opened, those fields of its manifest that have their names."""
    size_bytes: int
    rows: int
    """Grasps, pairs of grasp and scene, or pictures."""
    info: Mapping[str, Any]
    """Remarks of the stage: seconds of its parts, tries that came to nothing."""
    revision: int | None = None


def pieces(contents: Contents) -> Iterator[Piece]:
    """Every shard, in the order of `Shards`; the next ones are fetched meanwhile, a bounded number at a time."""
    sizes = {shard.id: shard.size_bytes for shard in contents.snapshot.shards} if contents.snapshot else {}
    with ThreadPoolExecutor(_THREADS, thread_name_prefix="card") as pool:
        files = iter(contents.shards)
        while some := list(islice(files, _AT_ONCE)):
            yield from pool.map(lambda file: _piece(contents, file, sizes.get(file.id)), some)


def _piece(contents: Contents, file: ShardFile, size: int | None) -> Piece:
    manifest = _manifest(contents, file)
    if manifest is not None and file.kind == "views":
        return _unopened(file, manifest)
    path = contents.shards.path(file)
    with open_shard(path) as opened:
        said = {key: _plain(value) for key, value in opened.attrs.items()}
        columns = {name: read_column(opened, name, str(path)) for name in COLUMNS[file.kind] if name in opened}
        rows = len(opened[{"base": "quality/valid", "scene": "grasp/valid", "views": "camera/eye"}[file.kind]])
    if manifest is not None:
        said = {**_unopened(file, manifest).said, **said}
    return Piece(
        file,
        columns,
        said,
        size or path.stat().st_size,
        rows,
        manifest.info if manifest else {},
        manifest.stage_revision if manifest else None,
    )


def _manifest(contents: Contents, file: ShardFile) -> ShardManifest | None:
    store = contents.shards.store
    if store is None:
        return None
    try:
        return load_manifest(store, _STAGES[file.kind], file.id)
    except NotFoundError:
        return None


def _unopened(file: ShardFile, manifest: ShardManifest) -> Piece:
    said: dict[str, Any] = {
        "seconds": manifest.seconds,
        "device": manifest.device,
        "worker": manifest.worker,
        "seed": manifest.seed,
        "created": manifest.created,
        "code_version": manifest.code_version,
        "method": manifest.request.method,
        "fidelity": json_attribute(manifest.request.knobs.model_dump(mode="json")),
        "want": manifest.request.want,
    }
    if file.kind == "base":
        said["tried"] = manifest.tried
    return Piece(file, {}, said, manifest.size_bytes, manifest.count, manifest.info, manifest.stage_revision)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [str(entry) for entry in value]
    return value.item() if isinstance(value, np.generic) else value
