"""A dataset with known contents: built-in hands and objects, true shards, grasps drawn at random or as a test wants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.planning import message_of, plan
from graspd.service.model.records import AttemptRecord, JobRecord, Snapshot
from graspd.service.model.states import Stage
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.settings import Settings
from graspd.service.store.manifests import publish_shard
from graspd.service.store.records import put_record, read_record
from graspd.service.store.shards import json_attribute
from graspd.service.store.store import open_store
from graspd.worker.stages.context import Output, shard_of
from tests.api.factories import add_builtins, poses, scene_columns
from tests.indexes import empty_index
from tests.memory_queue import MemoryQueue
from tests.planning import plan_all

HANDS = ("allegro", "barrett")
OBJECTS = ("block", "mug")
NAME = "kitchen"
#: Of the last joint of this hand the card must say that it never moves.
STILL_HAND, STILL_JOINT = "barrett", "finger_1_spread"
BARRETT = (
    "finger_1_spread",
    "finger_1_medial",
    "finger_1_distal",
    "finger_2_spread",
    "finger_2_medial",
    "finger_2_distal",
    "finger_3_medial",
    "finger_3_distal",
)
SECONDS = {Stage.SYNTHESIZE: 2.0, Stage.SCENE: 0.5, Stage.RENDER: 1.5}
Array = NDArray[Any]


@dataclass
class Made:
    """Its services, the dataset's snapshot, and where its store is."""

    services: Services
    snapshot: Snapshot
    url: str


def dataset(
    folder: Path,
    url: str,
    *,
    change: Callable[[str, str, dict[str, Array]], None] = lambda hand, obj, columns: None,
    fails: tuple[str, str] | None = None,
    grasps: int = 40,
    **options: Any,
) -> Made:
    """Two hands x two objects, two batches each, with scenes and pictures.

    Args:
        folder: of the index.
        url: of the store.
        change: may change a base shard's columns before it is written.
        fails: a cell whose first task fails for good.
        grasps: wanted of each cell.
        options: of the jobs.
    """
    index = f"sqlite:///{folder / 'index.sqlite'}"
    services = Services(Settings(data_dir=folder), open_store(url), empty_index(index), MemoryQueue())
    add_builtins(services)
    given = {"scenes": 2, "views": 1, "width": 24, "height": 16, **options}
    wanted = DatasetRequest.model_validate(
        {"name": NAME, "hands": HANDS, "objects": OBJECTS, "grasps": grasps, **given}
    )
    actions.create(services, wanted)
    plan_all(services)
    for cell in services.index.datasets.cells(NAME, limit=200).items:
        record = read_record(JobRecord, services.store, names.job_record(cell.job_id))
        if (cell.hand, cell.object) == fails:
            _fail(services, record)
        else:
            _finish(services, record, change)
    return Made(services, actions.snapshot(services, NAME)[0], url)


def _fail(services: Services, record: JobRecord) -> None:
    task = next(plan(record))
    attempt = AttemptRecord(
        task_id=task.id,
        job_id=record.id,
        stage=task.stage,
        number=1,
        kind="MeshError",
        reason="the mesh is torn",
        worker="w",
        ended=timestamp(),
        last=True,
    )
    put_record(services.store, names.attempt(task.id, 1), attempt)
    services.index.write.add_attempt(attempt)


def _finish(services: Services, record: JobRecord, change: Callable[[str, str, dict[str, Array]], None]) -> None:
    base: dict[str, Array] = {}
    for task in plan(record):
        rng = np.random.default_rng([task.batch, *map(ord, record.request.hand + record.request.object)])
        message = message_of(record, task, attempt=1, max_attempt=3)
        scenes = record.request.scenes
        place: dict[str, Any] = {}
        if record.request.in_scene:
            place = {"scene": json_attribute(record.request.place.model_dump(mode="json"))}
        if task.stage is Stage.SYNTHESIZE:
            base = _base(rng, record.request.hand, task.count, task.batch)
            change(record.request.hand, record.request.object, base)
            made = len(base["quality/valid"])
            rejected = {"diverged": 0, "dropped": made // 4, "gate": 1}
            candidates = made + made // 4 + 1
            joints = BARRETT if record.request.hand == "barrett" else _ALLEGRO
            attributes: dict[str, Any] = {
                "joint_names": list(joints),
                "mu": 1.0,
                "want": "valid",
                "candidates": candidates,
                "verdict_level": "standard",
                "verdict_key": "k",
            }
            if place:
                # At half the friction every other grasp of a scene lifts.
                base["quality/lift_hard"] = (np.arange(made) % 2).astype(np.int8)
                attributes |= place
            output = Output(base, attributes, {"planner_seconds": 1.0, "rejected": rejected})
        elif task.stage is Stage.SCENE and place:
            output = Output(_scene(rng, 0, scenes), place)
        elif task.stage is Stage.SCENE:
            output = Output(_scene(rng, len(base["quality/valid"]), scenes), {"base_shard": task.inputs[0]})
        else:
            output = Output(_views(scenes * record.request.views), {"scene_shard": task.inputs[0], **place})
        manifest, data = shard_of(message, output, device="cpu", seconds=SECONDS[task.stage], worker="w1")
        publish_shard(services.store, manifest, data)
        services.index.write.add_manifest(manifest)


_ALLEGRO = tuple(
    f"{finger}_{joint}"
    for finger, first in (("index", "abduction"), ("middle", "abduction"), ("ring", "abduction"), ("thumb", "rotation"))
    for joint in (first, "proximal", "middle", "distal")
)


def _base(rng: np.random.Generator, hand: str, count: int, batch: int) -> dict[str, Array]:
    joints = len(BARRETT if hand == "barrett" else _ALLEGRO)
    thresholds = np.array([0.001, 0.005])
    columns: dict[str, Array] = {"quality/thresholds_m": thresholds}
    for posture in ("grasp", "pregrasp", "squeeze"):
        columns[f"{posture}/hand_pose"] = poses(rng, count)
        columns[f"{posture}/joint_positions"] = rng.uniform(0.0, 0.5, (count, joints))
    if hand == STILL_HAND:
        columns["grasp/joint_positions"][:, BARRETT.index(STILL_JOINT)] = -1.0
    for name, scale in (("contact_area_cm2", 40.0), ("epsilon", 0.3), ("wrench_volume", 3.0)):
        columns[f"quality/{name}"] = rng.gamma(9.0, scale / 9, (count, 2))
    for name, scale in (
        ("intersection_volume_cm3", 0.01),
        ("penetration_depth_mm", 0.3),
        ("self_penetration_depth_mm", 0.01),
        ("simulated_displacement_cm", 0.05),
        ("stability_loss", 0.05),
    ):
        columns[f"quality/{name}"] = rng.gamma(2.0, scale / 2, count)
    columns["quality/contact_links"] = rng.integers(2, 9, count).astype(np.int32)
    columns["quality/valid"] = np.ones(count, np.uint8)
    columns["quality/success"] = np.ones(count, np.int8)
    if batch == 0:
        columns["quality/recheck"] = np.where(np.arange(count) < 8, 1, -1).astype(np.int8)
    return columns


def _scene(rng: np.random.Generator, count: int, scenes: int) -> dict[str, Array]:
    columns = scene_columns(rng, count, scenes, clear=0.1)
    return columns | {"grasp/rejection": (1 - columns["grasp/valid"]).astype(np.uint8)}


def _views(count: int) -> dict[str, Array]:
    height, width = 16, 24
    return {
        "camera/intrinsics": np.tile(np.eye(3), (count, 1, 1)),
        "camera/extrinsics": np.tile(np.eye(4), (count, 1, 1)),
        "camera/scene_index": np.arange(count, dtype=np.int32) % 2,
        "camera/eye": np.zeros(count, np.uint8),
        "camera/stereo_baseline_m": np.zeros(count),
        "image/rgb": np.full((count, height, width, 3), 120, np.uint8),
        "image/depth": np.ones((count, height, width), np.float32),
        "image/segmentation": np.ones((count, height, width), np.uint8),
        "box/bounding_box_2d_tight": np.zeros((count, 4), np.float32),
        "box/bounding_box_2d_loose": np.zeros((count, 4), np.float32),
        "box/bounding_box_3d": np.zeros((count, 8, 3), np.float32),
    }
