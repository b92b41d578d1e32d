"""Input of a card: the shards of a snapshot or folder, read one by one without pictures."""

import json
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic_core import from_json

from graspd.service.model import names
from graspd.service.model.errors import InputError, NotFoundError
from graspd.service.model.metrics import GRASP_METRICS
from graspd.service.model.planning import plan_tasks
from graspd.service.model.records import DatasetRecord, Snapshot, create_job_record
from graspd.service.model.states import AssetKind
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.readers import ShardFile, Shards, open_shards
from graspd.service.store import validity
from graspd.service.store.assets import BUILTIN_LICENCE, builtin_asset, builtin_files, builtin_names
from graspd.service.store.library import load_asset, load_asset_files, load_check
from graspd.service.store.manifests import ShardManifest, load_manifest
from graspd.service.store.records import load_dataset, newest_snapshot, parse_record, task_attempts
from graspd.service.store.shards import json_attribute, open_shard, read_column
from graspd.service.store.store import Store

Pair = tuple[str, str]


@dataclass(frozen=True)
class AssetFacts:
    """Facts of a hand or object in the store; unknown fields are empty."""

    name: str
    digest: str = ""
    licence: str = ""
    source: str = ""
    description: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)  # measurements from its ingest check, SI units


@dataclass(frozen=True)
class Contents:
    """Input of a card; a folder of shards has no `record`, and a `snapshot` only if it is an export."""

    name: str
    shards: Shards
    hands: Mapping[str, AssetFacts]
    objects: Mapping[str, AssetFacts]
    snapshot: Snapshot | None = None
    record: DatasetRecord | None = None
    gaps: Mapping[Pair, tuple[int, str]] = field(default_factory=dict)
    """For each cell, the number of batches missing in the snapshot, and the reason."""
    root: Path | None = None  # folder of the shards; None for shards in a store


def contents_of_store(store: Store, dataset: str, snapshot: str | None = None, cache: Path | None = None) -> Contents:
    """Return a snapshot of a dataset, by default the newest.
    Raises NotFoundError: the dataset or the snapshot does not exist; StoreUnavailable: the store does not answer."""
    taken = newest_snapshot(store, dataset, snapshot)
    record = load_dataset(store, dataset)
    there = {shard.id for shard in taken.shards}
    gaps = {}
    for cell in record.cells():
        tasks = plan_tasks(create_job_record(cell, record.options, record.revisions))
        if missing := [task for task in tasks if task.output not in there]:
            reasons = (attempts[-1].reason for task in missing if (attempts := task_attempts(store, task.id)))
            gaps[cell.hand.name, cell.object.name] = len(missing), next(reasons, "not made yet, or cancelled")
    return Contents(
        dataset,
        open_shards(store, dataset=dataset, snapshot=taken.digest, cache=cache),
        {hand.name: _stored_asset(store, AssetKind.HAND, hand.name, hand.digest) for hand in record.hands},
        {obj.name: _stored_asset(store, AssetKind.OBJECT, obj.name, obj.digest) for obj in record.objects},
        taken,
        record,
        gaps,
    )


def contents_of_folder(folder: Path) -> Contents:
    """Return the shards of a folder, such as an export; only built-in hands and objects have facts.
    Raises NotFoundError: the folder contains no shard; InputError: a file is no shard or damaged."""
    shards = open_shards(folder)
    listed = folder / "snapshot.json"
    taken = parse_record(Snapshot, listed.read_bytes(), str(listed)) if listed.is_file() else None
    hands, objects = (
        {known: _builtin_asset(kind, known, digest) for known, digest in sorted(_digests(shards, kind).items())}
        for kind in (AssetKind.HAND, AssetKind.OBJECT)
    )
    name = taken.dataset if taken else folder.resolve().name
    return Contents(name, shards, hands, objects, taken, root=folder)


def add_provenance(contents: Contents, file: Path) -> Contents:
    """Add licences, sources and descriptions of hands and objects from a JSON file.
    Its form is `{"hands": {"shadow": {"licence": "...", "source": "..."}}, "objects": {"*": {...}, "mug": {...}}}`,
    where `*` stands for all other assets. Raises InputError: the JSON is invalid or names unknown assets."""
    try:
        said = from_json(file.read_bytes())
        groups = {kind: {str(k): dict(v) for k, v in said.get(kind, {}).items()} for kind in ("hands", "objects")}
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror}") from None
    except (ValueError, AttributeError, TypeError):
        raise InputError(f'{file} must hold {{"objects": {{"mug": {{"licence": "...", "source": "..."}}}}}}') from None
    hands, objects = (_with_facts(getattr(contents, kind), said, file) for kind, said in groups.items())
    return replace(contents, hands=hands, objects=objects)


def _with_facts(
    assets: Mapping[str, AssetFacts], said: Mapping[str, Mapping[str, Any]], file: Path
) -> dict[str, AssetFacts]:
    if unknown := set(said) - set(assets) - {"*"}:
        raise InputError(f"{file} names {sorted(unknown)[0]!r}, which the dataset lacks")
    informed = {}
    for name, asset in assets.items():
        own = said.get(name, said.get("*", {}))
        if wrong := set(own) - {"licence", "source", "description"}:
            raise InputError(f"{file}: {name} has {sorted(wrong)[0]!r}; known keys are licence, source and description")
        words = {key: str(own.get(key, getattr(asset, key))) for key in ("licence", "source", "description")}
        informed[name] = replace(asset, **words)  # type: ignore[arg-type]
    return informed


def _stored_asset(store: Store, kind: AssetKind, name: str, digest: str) -> AssetFacts:
    try:
        files = load_asset_files(store, kind, digest)
        builtin = load_asset(store, kind, digest).builtin
    except NotFoundError:
        return AssetFacts(name, digest)
    check = load_check(store, kind, digest) or {}
    facts = check.get("facts") or (_checked_facts(kind, name) if builtin else {})
    return _asset_facts(name, digest, files, facts, builtin=builtin)


def _builtin_asset(kind: AssetKind, name: str, digest: str) -> AssetFacts:
    if name in builtin_names(kind):
        asset, files = builtin_asset(kind, name)
        if asset.digest == digest:
            return _asset_facts(name, digest, files, _checked_facts(kind, name), builtin=True)
    return AssetFacts(name, digest)


def _asset_facts(name: str, digest: str, files: Mapping[str, bytes], facts: Any, *, builtin: bool) -> AssetFacts:
    stated = json.loads(files["asset.json"])
    licence, source = str(stated.get("licence", "")), str(stated.get("source", ""))
    if builtin:
        licence, source = licence or BUILTIN_LICENCE, source or f"built into graspd {PACKAGE_VERSION}"
    return AssetFacts(name, digest, licence, source, str(stated.get("description", "")), dict(facts))


@lru_cache
def _checked_facts(kind: AssetKind, name: str) -> dict[str, Any]:
    files = builtin_files(kind, name)
    if kind is AssetKind.HAND:
        from graspd.worker.hands.check import check_hand

        return dict(check_hand(files, name)["facts"])
    from graspd.worker.objects.formats import read_mesh
    from graspd.worker.objects.options import UNITS, parse_options
    from graspd.worker.objects.prepare import main_mesh

    options = parse_options(files)
    vertices = read_mesh(*main_mesh(files, options)).vertices * UNITS[options.units]
    return {"extents_m": [float(extent) for extent in np.ptp(vertices, axis=0)]}


def _digests(shards: Shards, kind: AssetKind) -> dict[str, str]:
    found: dict[str, str] = {}
    for file in shards:
        name = file.hand if kind is AssetKind.HAND else file.object
        if name not in found:
            with open_shard(shards.path(file)) as opened:
                found[name] = str(opened.attrs.get(f"{kind.value}_digest", ""))
    return found


#: Columns used for a card; missing ones are skipped.
COLUMNS: Final[dict[str, tuple[str, ...]]] = {
    "base": (
        "grasp/hand_pose",
        "grasp/joint_positions",
        "quality/thresholds_m",
        *(metric.path for metric in GRASP_METRICS),
        *validity.COLUMNS,
        "quality/recheck",
        "quality/agreement",
        "quality/lift_hard",
    ),
    "scene": ("grasp/base_index", "grasp/hand_pose", "grasp/valid", "grasp/rejection", "scene/object_pose"),
    "views": (),
    "episodes": ("episode/outcome",),
}
_ROWS: Final = {"base": "quality/valid", "scene": "grasp/valid", "views": "camera/eye", "episodes": "episode/outcome"}
_STAGES: Final = {kind: stage for stage, kind in names.SHARD_KINDS.items()}
_AT_ONCE: Final = 64
_THREADS: Final = 8


@dataclass(frozen=True)
class ShardContents:
    """A shard's columns, attributes, and metadata of its manifest."""

    file: ShardFile
    columns: Mapping[str, NDArray[Any]]
    said: Mapping[str, Any]
    """Root attributes; for a shard that is not opened, the manifest's fields of the same names."""
    size_bytes: int
    rows: int  # number of grasps, of pairs of grasp and scene, or of pictures
    info: Mapping[str, Any] = field(default_factory=dict)
    """Info of the stage: seconds of its parts, rejected candidates."""
    revision: int | None = None


def read_shards(contents: Contents) -> Iterator[ShardContents]:
    """Yield all shards in the order of `Shards`; read some ahead."""
    sizes = {shard.id: shard.size_bytes for shard in contents.snapshot.shards} if contents.snapshot else {}
    with ThreadPoolExecutor(_THREADS, thread_name_prefix="card") as pool:
        files = iter(contents.shards)
        while some := list(islice(files, _AT_ONCE)):
            yield from pool.map(lambda file: _read_shard_file(contents, file, sizes.get(file.id)), some)


def _read_shard_file(contents: Contents, file: ShardFile, size: int | None) -> ShardContents:
    manifest = _manifest(contents, file)
    unopened = None if manifest is None else _unread_shard(file, manifest)
    if unopened is not None and file.kind == "views":
        return unopened
    path = contents.shards.path(file)
    with open_shard(path) as opened:
        said = {key: _json_value(value) for key, value in opened.attrs.items()}
        columns = {name: read_column(opened, name, str(path)) for name in COLUMNS[file.kind] if name in opened}
        rows = len(opened[_ROWS[file.kind]])
    found = ShardContents(file, columns, said, size or path.stat().st_size, rows)
    if unopened is None:
        return found
    return replace(found, said={**unopened.said, **said}, info=unopened.info, revision=unopened.revision)


def _manifest(contents: Contents, file: ShardFile) -> ShardManifest | None:
    store = contents.shards.store
    if store is None:
        return None
    try:
        return load_manifest(store, _STAGES[file.kind], file.id)
    except NotFoundError:
        return None


def _unread_shard(file: ShardFile, manifest: ShardManifest) -> ShardContents:
    copied = ("seconds", "device", "worker", "seed", "created", "code_version")
    said: dict[str, Any] = {name: getattr(manifest, name) for name in copied}
    said |= {
        "method": manifest.request.method,
        "fidelity": json_attribute(manifest.request.resolved_fidelity.model_dump(mode="json")),
        "want": manifest.request.want,
    }
    if file.kind == "base":
        said["candidates"] = manifest.candidates
    return ShardContents(file, {}, said, manifest.size_bytes, manifest.count, manifest.info, manifest.stage_revision)


def _json_value(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [str(entry) for entry in value]
    return value.item() if isinstance(value, np.generic) else value
