"""Manifests of shards, written last and create-only, with all data for the index."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from graspd.service.model import names
from graspd.service.model.base import Digest, json_value
from graspd.service.model.clock import timestamp
from graspd.service.model.domain import JobRequest, count_batches
from graspd.service.model.messages import TaskMessage
from graspd.service.model.metric_fields import insert_fields, value_fields
from graspd.service.model.metrics import indexed_metrics, perturbed_parameter_name
from graspd.service.model.records import Record
from graspd.service.model.states import Stage
from graspd.service.model.version import PACKAGE_VERSION, STAGE_REVISIONS
from graspd.service.store import validity
from graspd.service.store.columns import EPISODE_OUTCOMES, SCHEMAS, ShardKind, schema_name
from graspd.service.store.integrity import read_checked
from graspd.service.store.records import put_record, read_record
from graspd.service.store.shards import Shard, read_shard
from graspd.service.store.store import Store

#: Contact threshold of the metrics in the index [m]: the widest in the literature.
INDEX_THRESHOLD_M: Final = 0.005


@insert_fields(valid=value_fields(optional=False, default=None), last=value_fields(optional=True, default=None))
class GraspSummary(Record):
    """Quality of one grasp, in the units of the shard's columns; None replaces nan."""

    valid: bool
    success: bool | None = None
    verdict_level: str | None = Field(None, description="level of validation of `success`")
    lift_hard: bool | None = Field(None, description="in a scene: lifted at half friction")
    robust_weakest: str | None = Field(
        None, description="perturbed parameter of the first failed model; None: held in all models, or not tested"
    )


class ShardManifest(Record):
    version: Literal[1] = 1
    shard_id: Digest
    stage: Stage
    kind: ShardKind
    key: str
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    size_bytes: int = Field(gt=0)
    counts: dict[str, int] = Field(
        description="lengths of the shard's axes: N grasps, S scenes, K pairs, V views, E episodes"
    )
    hand: str
    object: str
    hand_digest: Digest
    object_digest: Digest
    request: JobRequest
    seed: int
    batch: int
    batches: int = Field(1, ge=1, description="number of batches, starting with `batch`")
    inputs: tuple[str, ...]
    code_version: str
    stage_revision: int
    shard_schema: str
    created: str
    device: str
    seconds: float
    worker: str
    valid: int = Field(
        0,
        description="base: valid grasps; scene: pairs of grasp and scene in which the hand is clear; "
        "episodes: successful ones",
    )
    candidates: int = Field(0, ge=0, description="candidates planned for this base shard, stored or not")
    rechecked: int = Field(0, ge=0, description="valid grasps validated again at level `dexgraspbench`")
    recheck_held: int = Field(0, ge=0, description="rechecked grasps that held")
    index_threshold_m: float | None = None
    grasps: tuple[GraspSummary, ...] = ()
    episodes: dict[int, str] = Field(
        {}, exclude_if=lambda value: not value, description="outcome of each episode, by the grasp's row in its shard"
    )
    info: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_summaries(self) -> ShardManifest:
        if self.stage is Stage.SYNTHESIZE and len(self.grasps) != self.counts.get("N"):
            raise ValueError("a base shard's manifest has a summary of each grasp")
        return self

    @property
    def validated(self) -> int:
        """Number of candidates tested against the geometric limits and in validation; 0 without validation."""
        has_verdicts = any(grasp.success is not None for grasp in self.grasps)
        return self.candidates if has_verdicts or (not self.grasps and self.request.validation != "none") else 0

    @property
    def count(self) -> int:
        """Number of grasps, views, episodes, scenes, or pairs of grasp and scene, according to the kind."""
        scenes = "S" if self.request.in_scene else "K"
        return self.counts.get({"base": "N", "scene": scenes, "views": "V", "episodes": "E"}[self.kind], 0)


def create_manifest(
    message: TaskMessage,
    data: bytes,
    arrays: Mapping[str, NDArray[Any]],
    attributes: Mapping[str, Any],
    counts: Mapping[str, int],
    *,
    device: str,
    seconds: float,
    worker: str,
    info: Mapping[str, Any] | None = None,
) -> ShardManifest:
    """Return the manifest of the result of a task: `data` are the bytes of the shard, `counts` its axes."""
    kind = names.SHARD_KINDS[message.stage]
    shared = {name: getattr(message, name) for name in ("hand_digest", "object_digest", "request", "batch", "inputs")}
    return ShardManifest(
        shard_id=message.output,
        stage=message.stage,
        kind=kind,
        key=names.shard_file_key(message.stage, message.output),
        sha256=hashlib.sha256(data).hexdigest(),
        size_bytes=len(data),
        counts=dict(counts),
        hand=message.request.hand,
        object=message.request.object,
        seed=message.request.seed,
        batches=count_batches(message.count),
        code_version=PACKAGE_VERSION,
        stage_revision=STAGE_REVISIONS[message.stage],
        shard_schema=schema_name(kind),
        created=str(attributes.get("created") or timestamp()),
        device=device,
        seconds=round(seconds, 4),
        worker=worker,
        info=dict(info or {}),
        **shared,
        **_content_fields(kind, arrays, attributes),
    )


def _content_fields(kind: str, arrays: Mapping[str, NDArray[Any]], attributes: Mapping[str, Any]) -> dict[str, Any]:
    if kind == "episodes":
        outcomes = [EPISODE_OUTCOMES[code] for code in arrays["episode/outcome"].tolist()]
        episodes = dict(zip(arrays["episode/row"].tolist(), outcomes, strict=True))
        return {"episodes": episodes, "valid": outcomes.count(EPISODE_OUTCOMES[0])}
    valid = validity.valid_mask(arrays) if kind == "base" else arrays.get("grasp/valid")
    fields: dict[str, Any] = {"valid": 0 if valid is None else int(np.count_nonzero(valid))}
    if kind == "base":
        recheck = arrays.get("quality/recheck", np.empty(0, np.int8))
        fields["index_threshold_m"], fields["grasps"] = _grasp_summaries(arrays, attributes)
        fields["candidates"] = int(attributes.get("candidates", len(arrays["quality/valid"])))
        fields["rechecked"] = int(np.count_nonzero(recheck >= 0))
        fields["recheck_held"] = int(np.count_nonzero(recheck == 1))
    return fields


def _grasp_summaries(
    arrays: Mapping[str, NDArray[Any]], attributes: Mapping[str, Any]
) -> tuple[float, tuple[GraspSummary, ...]]:
    """Return the contact threshold nearest to `INDEX_THRESHOLD_M` [m], and the quality of grasps at it."""
    thresholds = np.asarray(arrays["quality/thresholds_m"], float)
    at = int(np.argmin(np.abs(thresholds - INDEX_THRESHOLD_M)))
    count = len(arrays["quality/valid"])
    columns: dict[str, list[Any]] = {
        metric.name: json_value(np.asarray(arrays[metric.path], float)[(..., at) if metric.swept else ...].tolist())
        for metric in indexed_metrics()
        if not metric.optional or metric.path in arrays
    }
    columns["valid"] = validity.valid_mask(arrays).tolist()
    for name in ("success", "lift_hard"):
        columns[name] = [_decode_verdict(int(v)) for v in arrays.get(f"quality/{name}", np.full(count, -1))]
    level = attributes.get("verdict_level")
    columns["verdict_level"] = [None if verdict is None else level for verdict in columns["success"]]
    columns["robust_weakest"] = [
        perturbed_parameter_name(int(v)) for v in arrays.get("quality/robust_weakest", np.zeros(count))
    ]
    rows = zip(*columns.values(), strict=True)
    return float(thresholds[at]), tuple(GraspSummary(**dict(zip(columns, row, strict=True))) for row in rows)


def publish_shard(store: Store, manifest: ShardManifest, data: bytes) -> bool:
    """Store a shard, its manifest last; return False if it exists already, which is no error."""
    if not store.put(manifest.key, data):
        # Another process or an earlier attempt may have written the file: the manifest describes the stored bytes.
        manifest = rebuild_manifest(manifest.model_dump(mode="json"), store.get(manifest.key))
    return put_record(store, names.shard_manifest_key(manifest.stage, manifest.shard_id), manifest)


def load_manifest(store: Store, stage: Stage, shard: str) -> ShardManifest:
    return read_record(ShardManifest, store, names.shard_manifest_key(stage, shard))


def load_shard(store: Store, stage: Stage, shard: str) -> Shard:
    manifest = load_manifest(store, stage, shard)
    return read_shard(read_checked(store, manifest.key, manifest.sha256), kind=manifest.kind, name=manifest.key)


def shard_exists(store: Store, stage: Stage, shard: str) -> bool:
    return store.exists(names.shard_manifest_key(stage, shard))


def rebuild_manifest(said: Mapping[str, Any], data: bytes) -> ShardManifest:
    """Return the manifest of the shard `data`; other fields come from the existing manifest `said`."""
    pictures = tuple(path for kind in SCHEMAS for path in SCHEMAS[kind] if path.startswith(("image/", "video/")))
    shard = read_shard(data, without=pictures, name=said["key"])
    file = {"sha256": hashlib.sha256(data).hexdigest(), "size_bytes": len(data)}
    content = _content_fields(said["kind"], shard.arrays, shard.attributes)
    return ShardManifest.model_validate({**said, **file, **content})


def _decode_verdict(value: int) -> bool | None:
    return None if value < 0 else bool(value)
