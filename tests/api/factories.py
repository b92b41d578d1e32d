"""Jobs in any state, made as the pipeline and the workers make them: records in the store, rows in the index."""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from graspd.api.access.keys import KeyFile, Scope
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import job_id
from graspd.service.model.domain import JobRequest
from graspd.service.model.metrics import PerturbedParameter
from graspd.service.model.planning import PlannedTask, create_task_message, plan_tasks
from graspd.service.model.records import JobRecord
from graspd.service.model.states import AssetKind, Priority, Stage
from graspd.service.model.transforms import pose_to_matrix
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from graspd.service.store.columns import Attribute
from graspd.service.store.library import publish_builtins
from graspd.service.store.manifests import ShardManifest, create_manifest, publish_shard
from graspd.service.store.records import put_record
from graspd.service.store.shards import check_columns, read_shard, write_shard
from tests.fakes import beat_of, fail_task

JOINTS = 16
Arrays = dict[str, NDArray[np.generic]]


def add_builtins(services: Services) -> None:
    for asset in publish_builtins(services.store):
        services.index.write.add_asset(asset, {"verdict": "accept", "message": "", "repairs": [], "facts": {}})


def add_job(services: Services, **fields: object) -> JobRecord:
    request = JobRequest.model_validate({"hand": "allegro", "object": "mug", "grasps": 32} | fields)
    hand = services.index.assets.get(AssetKind.HAND, request.hand).digest
    object_ = services.index.assets.get(AssetKind.OBJECT, request.object).digest
    of = {"id": job_id(request, hand, object_), "hand_digest": hand, "object_digest": object_}
    record = JobRecord(**of, request=request, priority=Priority.INTERACTIVE, created=timestamp())
    put_record(services.store, names.job_record_key(record.id), record)
    services.index.write.add_job(record)
    return record


def finish(services: Services, record: JobRecord, task: PlannedTask, **info: object) -> ShardManifest:
    """A task's shard, with columns of the right shapes and random values, as a worker publishes it."""
    random = np.random.default_rng(task.batch)
    arrays = _ARRAYS[task.stage](random, task.count, record.request)
    attributes: dict[str, Attribute] = {"hand": record.request.hand, "object": record.request.object}
    attributes |= {"shard_id": task.output, "batch": task.batch}
    if task.inputs:
        reads_base = task.stage in ((Stage.RENDER, Stage.EPISODE) if record.request.in_scene else (Stage.SCENE,))
        attributes["base_shard" if reads_base else "scene_shard"] = task.inputs[0]
    if task.stage is Stage.SYNTHESIZE:
        attributes["joint_names"] = [f"joint_{i}" for i in range(JOINTS)]
    return publish(services, record, task, arrays, attributes, info)


def publish(
    services: Services,
    record: JobRecord,
    task: PlannedTask,
    arrays: Arrays,
    attributes: dict[str, Attribute],
    info: Mapping[str, object] = MappingProxyType({}),
) -> ShardManifest:
    """A task's shard of these columns, in the store and in the index."""
    kind = names.SHARD_KINDS[task.stage]
    data = write_shard(kind, arrays, attributes)
    message = create_task_message(record, task, attempt=1, max_attempt=3)
    made = {"device": "cpu", "seconds": 12.5, "worker": "worker-1", "info": info}
    manifest = create_manifest(message, data, arrays, attributes, check_columns(kind, arrays), **made)
    publish_shard(services.store, manifest, data)
    services.index.write.add_manifests([manifest])
    return manifest


def finish_with(services: Services, file: Path, **fields: object) -> ShardManifest:
    """A job whose grasps are those of a base shard that `graspd synth` wrote of a built-in hand and object."""
    shard = read_shard(file, kind="base")
    said = {name: str(shard.attributes[name]) for name in ("hand", "object")}
    record = add_job(services, **said, grasps=len(shard["quality/valid"]), **fields)
    task = next(task for task in plan_tasks(record) if task.stage is Stage.SYNTHESIZE)
    attributes = shard.attributes | {"shard_id": task.output, "batch": task.batch}
    return publish(services, record, task, shard.arrays, attributes)


def finish_all(services: Services, record: JobRecord) -> list[ShardManifest]:
    return [finish(services, record, task) for task in plan_tasks(record)]


def fail(services: Services, record: JobRecord, reason: str) -> None:
    task = next(plan_tasks(record))
    fail_task(services, record.id, task, kind="MeshError", reason=reason, worker="worker-1", started=timestamp())


def add_worker(services: Services, name: str = "worker-1", state: str = "idle") -> None:
    beat = beat_of(name, host="here", device_name="x86_64, 2 cores", version="0.1.0", state=state)
    services.index.live.set_workers([beat], forget_before="2000-01-01T00:00:00Z")


def zipped(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def people_of(settings: Settings, **people: tuple[Scope, str]) -> dict[str, dict[str, str]]:
    """Headers of keys, by name; of each its scope and its project."""
    keys = KeyFile(settings.resolved_keys_file)
    return {name: bearer(keys.add(name, scope, project=project)) for name, (scope, project) in people.items()}


def poses(random: np.random.Generator, count: int) -> NDArray[np.float64]:
    """(N, 7) hand poses around the origin, turned at random."""
    quaternions = random.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.concatenate([random.normal(0, 0.1, (count, 3)), quaternions], axis=1)


def _base(random: np.random.Generator, count: int, request: JobRequest) -> Arrays:
    thresholds = np.array([0.001, 0.005])
    arrays: Arrays = {"quality/thresholds_m": thresholds}
    for posture in ("grasp", "pregrasp", "squeeze"):
        arrays[f"{posture}/hand_pose"] = poses(random, count)
        arrays[f"{posture}/joint_positions"] = random.normal(0.6, 0.3, (count, JOINTS))
    for name, scale in (("contact_area_cm2", 9.0), ("epsilon", 0.25), ("wrench_volume", 0.8)):
        arrays[f"quality/{name}"] = random.gamma(4.0, scale / 4, (count, len(thresholds)))
    for name, scale in (
        ("intersection_volume_cm3", 0.3),
        ("penetration_depth_mm", 0.8),
        ("self_penetration_depth_mm", 0.1),
        ("stability_loss", 0.05),
    ):
        arrays[f"quality/{name}"] = random.gamma(2.0, scale / 2, count)
    arrays["quality/contact_links"] = random.integers(2, 9, count).astype(np.int32)
    # Drawn from a generator of their own, so that what stands below is what it was without them.
    kinds = np.random.default_rng(count)
    arrays["quality/grasp_type"] = kinds.integers(1, 4, count).astype(np.int32)
    arrays["quality/approach_cell"] = kinds.integers(0, 48, count).astype(np.int32)
    more = np.random.default_rng(count + 1)
    arrays["quality/digits"] = more.choice([3, 5, 7, 15], count).astype(np.int32)
    if request.payload:
        arrays["quality/payload_kg"] = more.uniform(0.1, 1.2, count)
    arrays["quality/valid"] = (random.random(count) < 0.8).astype(np.uint8)
    if request.validation == "none":
        return arrays | {"quality/feasible": np.ones(count, np.uint8), "quality/valid": np.zeros(count, np.uint8)}
    arrays["quality/success"] = arrays["quality/valid"].astype(np.int8)
    if request.model_count:
        held = arrays["quality/success"] == 1
        share = kinds.integers(0, request.model_count + 1, count) / request.model_count
        weakest = kinds.integers(1, len(PerturbedParameter), count).astype(np.uint8)
        arrays["quality/robust_share"] = np.where(held, share, np.nan)
        arrays["quality/robust_weakest"] = np.where(held & (share < 1), weakest, np.uint8(PerturbedParameter.NONE))
    return arrays


def _scene(random: np.random.Generator, count: int, request: JobRequest) -> Arrays:
    return scene_columns(random, 0 if request.in_scene else count, request.scenes)


def scene_columns(random: np.random.Generator, count: int, scenes: int, clear: float = 0.5) -> Arrays:
    rows = count * scenes
    return {
        "scene/object_pose": poses(random, scenes),
        "scene/rest_probability": np.full(scenes, 1 / scenes),
        "scene/drop_seconds": np.full(scenes, 0.8),
        "grasp/base_index": np.tile(np.arange(count, dtype=np.int32), scenes),
        "grasp/scene_index": np.repeat(np.arange(scenes, dtype=np.int32), count),
        "grasp/hand_pose": poses(random, rows),
        "grasp/table_clearance_m": random.normal(0.01, 0.01, rows),
        "grasp/valid": (random.random(rows) < clear).astype(np.uint8),
    }


def _views(random: np.random.Generator, count: int, request: JobRequest) -> Arrays:
    eyes = 2 if request.stereo else 1
    views = request.scenes * request.views * eyes
    height, width = request.height, request.width
    shade = np.linspace(40, 220, width, dtype=np.uint8)
    return {
        "camera/intrinsics": np.tile(np.eye(3), (views, 1, 1)),
        "camera/extrinsics": pose_to_matrix(poses(random, views)),
        "camera/scene_index": np.repeat(np.arange(request.scenes, dtype=np.int32), request.views * eyes),
        "camera/eye": np.resize(np.array([1, 2] if request.stereo else [0], np.uint8), views),
        "camera/stereo_baseline_m": np.full(views, 0.06),
        "image/rgb": np.broadcast_to(shade[None, None, :, None], (views, height, width, 3)).copy(),
        "image/depth": np.ones((views, height, width), np.float32),
        "image/segmentation": np.ones((views, height, width), np.uint8),
        "box/bounding_box_2d_tight": np.zeros((views, 4), np.float32),
        "box/bounding_box_2d_loose": np.zeros((views, 4), np.float32),
        "box/bounding_box_3d": np.zeros((views, 8, 3), np.float32),
    }


def _episodes(random: np.random.Generator, count: int, request: JobRequest) -> Arrays:
    """Episodes of all grasps but the first: most succeed in two frames, every fifth is out of reach."""
    rows = np.arange(1, count, dtype=np.int32)
    outcome = np.where(rows % 5, 0, 5).astype(np.uint8)
    frames = np.where(outcome, 0, 2).astype(np.int32)
    arrays: Arrays = {"episode/row": rows, "episode/outcome": outcome, "episode/frames": frames}
    arrays |= {"episode/scene_index": np.zeros(count - 1, np.int32), "scene/object_pose": poses(random, 1)}
    arrays |= {f"frame/{name}": random.normal(size=(frames.sum(), 7 + JOINTS)) for name in ("state", "action")}
    arrays |= {"frame/phase": np.zeros(frames.sum(), np.uint8), "frame/object_pose": poses(random, frames.sum())}
    for camera in request.film:
        films = [f"{camera} {row}".encode() if number else b"" for row, number in zip(rows, frames, strict=True)]
        arrays[f"video/{camera}"] = np.frombuffer(b"".join(films), np.uint8)
        arrays[f"video/{camera}_bytes"] = np.array([len(film) for film in films])
    return arrays


_ARRAYS = {Stage.SYNTHESIZE: _base, Stage.SCENE: _scene, Stage.RENDER: _views, Stage.EPISODE: _episodes}
