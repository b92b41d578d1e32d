"""The stage of episodes: a real job of a flying hand on a table, killed, repeated, verified and deleted."""

from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest

from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import TaskCancelled
from graspd.service.model.messages import TaskMessage
from graspd.service.model.planning import create_task_message, plan_tasks
from graspd.service.model.records import JobRecord
from graspd.service.model.states import Stage, State
from graspd.service.pipeline import integrity, job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.deletion import GarbageCollector, delete_job
from graspd.service.queue.port import EventKind
from graspd.service.settings import Settings
from graspd.service.store.columns import EXECUTED
from graspd.service.store.manifests import ShardManifest, load_manifest, load_shard
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.subsets import open_source
from graspd.worker.process.runner import Runner
from graspd.worker.stages import episode, stage_table
from graspd.worker.stages.context import StopReason, TaskContext, build_shard
from tests.api.factories import add_builtins
from tests.fakes import record_of, with_settings
from tests.indexes import open_services

JOB = {"hand": "barrett", "object": "block", "grasps": 2, "fidelity": "draft", "scene": "table", "scenes": 2, "seed": 3}
JOB |= {"rechecks": 0, "episodes": "flying", "episode_fps": 10}


def message_of(job: JobRecord, stage: Stage) -> TaskMessage:
    task = next(task for task in plan_tasks(job) if task.stage is stage)
    return create_task_message(job, task, attempt=1, max_attempt=3)


def work(services: Services, job: JobRecord) -> ShardManifest:
    """Run the tasks of a job as a worker does; the manifest of its episodes."""
    runner = Runner(stage_table(), worker="w", publish=lambda event: None)
    for task in plan_tasks(job):
        message = create_task_message(job, task, attempt=1, max_attempt=3).model_dump(mode="json", by_alias=True)
        event = runner.run(message, TaskContext(services.store, ExecutionContext(threads=2)))
        assert event.kind is EventKind.FINISHED, event
        services.index.write.add_manifests([load_manifest(services.store, task.stage, task.output)])
    return load_manifest(services.store, Stage.EPISODE, task.output)


@pytest.fixture(scope="module")
def services(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Services]:
    opened = open_services(Settings(data_dir=tmp_path_factory.mktemp("episodes") / "data"))
    add_builtins(opened)
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def job(services: Services) -> JobRecord:
    return record_of(services, job_actions.submit(services, JobRequest(**JOB))[0].id)


@pytest.fixture(scope="module")
def made(services: Services, job: JobRecord) -> ShardManifest:
    return work(services, job)


def test_a_flying_hand_lifts_the_block_and_its_job_has_the_outcomes(
    services: Services, job: JobRecord, made: ShardManifest
) -> None:
    base, shard = (load_shard(services.store, stage, message_of(job, stage).output) for stage in _AFTER)
    assert list(made.episodes) == shard["episode/row"].tolist() == np.flatnonzero(base["quality/valid"]).tolist()
    view = services.index.jobs.get(job.id, details=True)
    assert (view.state, view.episodes) == (State.SUCCEEDED, dict(Counter(made.episodes.values())))
    assert made.valid >= 1 and set(made.episodes.values()) <= set(EXECUTED), "valid grasps are in a flying hand's reach"
    ends = np.cumsum(shard["episode/frames"])
    height = shard["frame/object_pose"][:, 2]
    for last, first, outcome in zip(ends - 1, ends - shard["episode/frames"], shard["episode/outcome"], strict=True):
        # The lift is 10 cm; a successful one loses at most 2 cm in the hand (`MAX_DISPLACEMENT_M`).
        assert outcome != 0 or height[last] - height[first] > 0.08
    assert shard.attributes["base_shard"] == message_of(job, Stage.SYNTHESIZE).output


_AFTER = (Stage.SYNTHESIZE, Stage.EPISODE)


def test_a_kill_in_the_middle_leaves_nothing_and_the_retry_repeats_the_bytes(
    services: Services, job: JobRecord, made: ShardManifest
) -> None:
    message, said = message_of(job, Stage.EPISODE), []

    def stop(done: float, total: float, what: str) -> None:
        said.append((done, total, what))
        context.stop(StopReason.SHUTDOWN)

    context = TaskContext(services.store, ExecutionContext(threads=1), tell=stop)
    with pytest.raises(TaskCancelled):
        episode.run(message, context)
    assert said == [(1, 2, "episodes")], "it stops between two episodes"
    again = episode.run(message, TaskContext(services.store, ExecutionContext(threads=1)))
    manifest, data = build_shard(message, again, device=made.device, seconds=0.0, worker="w", lost=made)
    assert (manifest.sha256, data) == (made.sha256, services.store.get(made.key)), "with another number of threads"


def test_a_batch_without_a_valid_grasp_has_an_empty_shard(
    services: Services, job: JobRecord, made: ShardManifest
) -> None:
    message = message_of(job, Stage.EPISODE)
    base = load_shard(services.store, Stage.SYNTHESIZE, message.inputs[0])
    with pytest.MonkeyPatch.context() as patch:
        none = {**base.arrays, "quality/valid": np.zeros_like(base["quality/valid"])}
        patch.setattr(episode.assets, "load_input", lambda *_: base.__class__("base", base.attributes, none))
        found = episode.run(message, TaskContext(services.store))
    manifest, _ = build_shard(message, found, device="cpu", seconds=0.0, worker="w")
    assert (manifest.count, manifest.valid, manifest.episodes) == (0, 0, {})


def test_a_store_with_episodes_is_verified_and_they_go_with_their_job(
    services: Services, job: JobRecord, made: ShardManifest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GRASPD_DATA_DIR", str(services.settings.data_dir))
    assert [file.id for file in open_source(job.id).of_kind("episodes")] == [made.shard_id], "exports name the job"
    folder = f"{names.SHARDS}/episodes"
    assert [damage for _, damage in integrity.scan(services.store) if damage] == []
    assert {key for key, _ in integrity.scan(services.store, folder)} >= {made.key}
    rows = differences(services.index, services.store)
    assert [row for row in rows if not row.startswith("assets")] == [], "an index made anew is the same"
    delete_job(services, job.id)
    GarbageCollector(services).execute_deletions()
    GarbageCollector(with_settings(services, shard_grace_s=-1.0)).collect(budget_s=60)
    assert list(services.store.list(names.SHARDS)) == []
