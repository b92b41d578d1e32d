"""Stand-ins for the engine: stages that make true shards of random numbers in no time, and a job to run them on."""

import argparse
import ctypes
import math
import os
import sys
import time
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial
from multiprocessing import Pipe
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from graspd.service.index.views import TaskView
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.domain import JobRequest
from graspd.service.model.messages import TaskMessage, WorkerHeartbeat
from graspd.service.model.planning import PlannedTask, create_task_message, plan_tasks
from graspd.service.model.records import AttemptRecord, JobRecord
from graspd.service.model.states import AssetKind, Priority, Stage
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets.actions import DatasetController
from graspd.service.store.integrity import put_document
from graspd.service.store.library import publish_asset
from graspd.service.store.manifests import ShardManifest, load_manifest, load_shard, publish_shard
from graspd.service.store.records import put_record, read_record
from graspd.service.store.store import Store
from graspd.worker.process.engine import Engine
from graspd.worker.process.fitness import Check
from graspd.worker.process.link import Link, Setup, StartEngine, start_engine
from graspd.worker.process.selfcheck import EngineError
from graspd.worker.stages.context import Output, StageFunction, TaskContext, build_shard
from graspd.worker.stages.ranges import base_rows, join_outputs, split_into_batches

HAND_FILES = {"asset.json": b'{"file": "hand.urdf"}', "hand.urdf": b"<robot name='fake'/>"}
OBJECT_FILES = {"asset.json": b'{"file": "ball.stl"}', "ball.stl": b"solid ball\nendsolid ball\n"}
ACCEPTED = {"verdict": "accept", "message": "fine", "repairs": [], "facts": {}}
_POSE = np.array([[0.0, 0, 0, 1, 0, 0, 0]])


def fake_synthesize(message: TaskMessage, context: TaskContext) -> Output:
    """A base shard whose numbers follow from seed and batch, as real ones do."""
    _pretend_to_work(context)
    return join_outputs(message, [_batch_of_grasps(batch, context) for batch in split_into_batches(message)])


def _batch_of_grasps(message: TaskMessage, context: TaskContext) -> Output:
    n, t = message.count, 3
    rng = np.random.default_rng([message.request.seed, message.batch])
    postures: dict[str, Any] = {}
    for name in ("grasp", "pregrasp", "squeeze"):
        postures[f"{name}/hand_pose"] = np.repeat(_POSE, n, axis=0)
        postures[f"{name}/joint_positions"] = rng.random((n, 2))
    quality = {
        "quality/thresholds_m": np.array([0.002, 0.005, 0.009]),
        "quality/contact_area_cm2": rng.random((n, t)),
        "quality/intersection_volume_cm3": rng.random(n),
        "quality/epsilon": rng.random((n, t)),
        "quality/wrench_volume": rng.random((n, t)),
        "quality/penetration_depth_mm": 3 * rng.random(n),
        "quality/self_penetration_depth_mm": rng.random(n),
        "quality/contact_links": rng.integers(0, 5, n),
        "quality/stability_loss": np.full(n, np.nan),
        "quality/valid": (valid := rng.integers(0, 2, n)),
        "quality/feasible": np.ones(n),
        "quality/success": valid,
    }
    if message.request.in_scene:
        assert context.store.exists(names.shard_manifest_key(Stage.SCENE, message.inputs[0]))
        quality |= {"quality/clearance_m": rng.random(n), "quality/lift_hard": valid}
    return Output({**postures, **quality}, {"joint_names": ["a", "b"]})


def fake_scene(message: TaskMessage, context: TaskContext) -> Output:
    _pretend_to_work(context)
    parts = split_into_batches(message)
    if message.request.in_scene:
        return join_outputs(message, [_scenes_of_batch(part) for part in parts])
    rows = base_rows(load_shard(context.store, Stage.SYNTHESIZE, message.inputs[0]), message)
    return join_outputs(message, [_scenes_of_batch(part) for part in parts], base_rows=rows)


def _scenes_of_batch(message: TaskMessage) -> Output:
    scenes = message.request.scenes
    rows = 0 if message.request.in_scene else scenes * message.count
    made = {"scene/object_pose": np.repeat(_POSE, scenes, axis=0), "grasp/hand_pose": np.repeat(_POSE, rows, axis=0)}
    made |= {"scene/rest_probability": np.ones(scenes), "scene/drop_seconds": np.ones(scenes)}
    made |= {"grasp/table_clearance_m": np.full(rows, 0.01), "grasp/valid": np.ones(rows)}
    base, scene = np.arange(rows) % message.count, np.arange(rows) // message.count
    return Output(made | {"grasp/base_index": base, "grasp/scene_index": scene})


def fake_stages() -> dict[Stage, Any]:
    return {Stage.SYNTHESIZE: fake_synthesize, Stage.SCENE: fake_scene}


def make_shard(store: Store, message: TaskMessage, *, worker: str = "w") -> ShardManifest:
    context = TaskContext(store)
    made = fake_stages()[message.stage](message, context)
    manifest, data = build_shard(message, made, device="cpu", seconds=0.5, worker=worker)
    return manifest if publish_shard(store, manifest, data) else load_manifest(store, manifest.stage, manifest.shard_id)


def put_asset(services: Services, kind: AssetKind, name: str, files: Mapping[str, bytes], check: Any = ACCEPTED) -> str:
    """A hand, an object or a network, and what its check found; its digest."""
    asset = publish_asset(services.store, kind, name, files)
    if check is not None:
        put_document(services.store, names.asset_key(kind, asset.digest, "check.json"), check)
    services.index.write.add_asset(asset, check)
    return asset.digest


def add_assets(services: Services) -> None:
    put_asset(services, AssetKind.HAND, "gripper", HAND_FILES)
    put_asset(services, AssetKind.OBJECT, "ball", OBJECT_FILES)


def with_settings(services: Services, **changes: Any) -> Services:
    return replace(services, settings=services.settings.model_copy(update=changes))


def record_of(services: Services, job: str) -> JobRecord:
    return read_record(JobRecord, services.store, names.job_record_key(job))


def make_task(services: Services, job: JobRecord, task: PlannedTask, **info: Any) -> ShardManifest:
    """A task of a job done on the spot, in store and index; the index believes `info` in its manifest."""
    made = make_shard(services.store, create_task_message(job, task, attempt=1, max_attempt=3))
    services.index.write.add_manifests([made.model_copy(update={"info": info}) if info else made])
    return made


def finish(services: Services, job: str, *, batches: float = math.inf, stage: Stage | None = None, **info: Any) -> None:
    for task in plan_tasks(record := record_of(services, job)):
        if task.batch < batches and stage in (None, task.stage):
            make_task(services, record, task, **info)


def plan_all(services: Services) -> None:
    """Plan all datasets in one round, however slow the machine: cells that are planned at once share the workers."""
    assert not DatasetController(services).advance(math.inf)


def tasks_of(job: JobRecord) -> list[TaskMessage]:
    tasks = [task for task in plan_tasks(job) if task.stage is Stage.SYNTHESIZE]
    return [create_task_message(job, task, attempt=1, max_attempt=3) for task in tasks]


def fail_task(services: Services, job: str, task: PlannedTask | TaskView, number: int = 1, **changes: Any) -> str:
    """A failed attempt at a task, the last one, in store and index; its key."""
    fields = {"kind": "ValueError", "reason": "it broke", "worker": "w", "ended": timestamp(), "last": True, **changes}
    attempt = AttemptRecord(task_id=task.id, job_id=job, stage=task.stage, number=number, **fields)
    put_record(services.store, key := names.attempt_key(task.id, number), attempt)
    services.index.write.add_attempt(attempt)
    return key


def beat_of(name: str = "w", **changes: Any) -> WorkerHeartbeat:
    now = timestamp()
    beat = WorkerHeartbeat(name, "host", 1, "cpu", "CPU", tuple(Stage), "0", "idle", "", now, now)
    return replace(beat, **changes)


def request(**changes: Any) -> JobRequest:
    return JobRequest(**{"hand": "gripper", "object": "ball", "grasps": 32, **changes})


def job_record(wanted: JobRequest, job: str = "c" * 32) -> JobRecord:
    """A job of a hand and an object that nobody stored."""
    digests = {"hand_digest": "a" * 32, "object_digest": "b" * 32}
    return JobRecord(id=job, request=wanted, priority=Priority.BULK, created=timestamp(), **digests)


def message_for(stage: Stage = Stage.SYNTHESIZE, *, attempt: int = 1, **changes: Any) -> TaskMessage:
    job = job_record(request(**changes))
    task = next(task for task in plan_tasks(job) if task.stage is stage)
    return create_task_message(job, task, attempt=attempt, max_attempt=3)


def hold_interpreter(seconds: float) -> None:
    if seconds > 0:
        ctypes.PyDLL(None).usleep(int(seconds * 1e6))


def _pretend_to_work(context: TaskContext) -> None:
    seconds, hold = float(os.environ.get("FAKE_SECONDS", "0")), Path(os.environ.get("FAKE_HOLD", "none"))
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0 or hold.exists():
        context.check()
        context.progress(min(seconds, seconds - left), seconds, "pretending")
        time.sleep(0.01)


def _die_untold(once: Path) -> None:
    from graspd.worker.process import runner

    def publish(*shard: Any) -> bool:
        is_new = publish_shard(*shard)
        if not once.exists():
            once.write_text(shard[1].shard_id)
            os.kill(os.getpid(), 9)
        return is_new

    runner.publish_shard = publish  # type: ignore[attr-defined]


def engine_of(table: Mapping[Stage, StageFunction], check: Check | None = None) -> StartEngine:
    def start(setup: Setup) -> Link:
        ours, theirs = Pipe()
        Thread(target=Engine(theirs, setup, table, check).serve, name="engine", daemon=True).start()
        return Link(ours)

    return start


def main() -> None:
    """A worker process with these stages: `python -m tests.fakes`.

    FAKE_LEAK_MB is memory that each task keeps, FAKE_LOCK_S is how long each task holds the interpreter lock; while
    there is a file FAKE_HOLD no task ends, and while there is a file FAKE_BROKEN nothing works. With FAKE_DIE_UNTOLD
    the worker that puts the first shard is killed before it tells; a file of that name says so. Of the options of
    `graspd worker` it takes `--burst` and `--idle`.
    """
    from graspd.service.settings import Settings
    from graspd.service.telemetry import set_up_logs
    from graspd.worker.process import engine
    from graspd.worker.process.main import run_worker

    table = fake_stages()
    leaked: list[bytes] = []

    broken = Path(os.environ.get("FAKE_BROKEN", "none"))

    def check(stages: Collection[Stage]) -> None:
        if broken.exists():
            raise EngineError("no kernel can be loaded")

    def synthesize(message: TaskMessage, context: TaskContext) -> Output:
        if broken.exists():
            raise ImportError("libengine.so")
        hold_interpreter(float(os.environ.get("FAKE_LOCK_S", "0")))
        leaked.append(b"1" * (2**20 * int(os.environ.get("FAKE_LEAK_MB", "0"))))
        return fake_synthesize(message, context)

    if once := os.environ.get("FAKE_DIE_UNTOLD"):
        _die_untold(Path(once))
    table |= {Stage.SYNTHESIZE: synthesize}
    if "--engine" in sys.argv:
        engine.main(table, check)
    settings = Settings()
    set_up_logs(settings, "worker")
    options = argparse.ArgumentParser()
    options.add_argument("--burst", action="store_true")
    options.add_argument("--idle", type=int, default=0)
    wanted, _ = options.parse_known_args()
    start = partial(start_engine, program=(sys.executable, "-m", "tests.fakes", "--engine"))
    ended_well = run_worker(settings, burst=wanted.burst, idle_s=wanted.idle, start=start)
    sys.exit(0 if ended_well else 1)


if __name__ == "__main__":
    main()
