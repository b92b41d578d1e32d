"""The real engine in real workers: a user's own files, a kill in the middle of the work, a network."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd.service.index.index import Index
from graspd.service.index.rebuild import differences
from graspd.service.model.domain import JobRequest
from graspd.service.model.states import AssetKind, Stage, State
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from graspd.service.store.shards import read_shard
from graspd.service.store.store import open_store
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.scenes.placement import scenes_of
from tests.system.conftest import System
from tests.waiting import PATIENCE_S, until_a_worker_is_idle
from tests.worker.commands_run import graspd, refused
from tests.worker.hands.urdfs import gripper_urdf


@pytest.mark.chaos
# What is planned free takes the same way through the workers as what is planned in scenes, and less of it.
@pytest.mark.parametrize("scene", [pytest.param("free", marks=pytest.mark.slow), "table"])
def test_a_worker_killed_in_mid_synthesis_leaves_the_same_grasps(start: Callable[..., System], scene: str) -> None:
    system = start(fakes=False, lease_s=2.0, retry_backoff_s=0.1)
    index = system.services.index
    system.until(
        lambda: {a.name for kind in AssetKind for a in index.assets.page(kind=kind).items} >= {"barrett", "block"},
        "the built-in assets are published",
    )

    def is_under_way(job: str) -> bool:
        tasks = index.jobs.tasks(job=job, state=State.RUNNING).items
        return any(task.stage is Stage.SYNTHESIZE and 0 < task.done < 0.9 * task.total for task in tasks)

    # On a busy machine one may be done before this process sees it under way, or kills its worker.
    for seed in range(7, 12):
        request = JobRequest(hand="barrett", object="block", grasps=24, fidelity="draft", seed=seed, scene=scene)
        job = system.submit(request)
        system.until(lambda job=job: is_under_way(job) or index.jobs.get(job).state.is_final, "its synthesis goes on")
        system.kill("worker-0")
        (done,) = system.finish(job)
        assert (done.state, done.grasps) == (State.SUCCEEDED, 24)
        if attempts := index.jobs.attempts(job=job):
            break
    assert [attempt.kind for attempt in attempts] == ["WorkerLost"]
    (shard,) = index.shards.page(job=job, kind="base").items
    kept = read_shard(system.services.store.get(shard.key))
    block = object_from_path("block", face_error_m=request.resolved_fidelity.face_error_m)
    scenes = None
    if request.in_scene:
        scenes, poses = scenes_of(request.scene_spec, block, [], count=request.scenes, seed=request.seed)
        np.testing.assert_array_equal(kept["scene/object_pose"], poses["scene/object_pose"])
    undisturbed = validated_grasps(hand_from_path("barrett"), block, request, count=24, scenes=scenes).grasps
    np.testing.assert_array_equal(kept["grasp/hand_pose"], undisturbed.grasp.hand_pose)
    np.testing.assert_array_equal(kept["grasp/joint_positions"], undisturbed.grasp.joint_positions)
    assert differences(index, system.services.store) == []


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hand without meshes, a box in millimetres, and a folder of two objects."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "pincer.urdf").write_bytes(gripper_urdf(coupled=False))
    trimesh.creation.box((60.0, 40.0, 30.0)).export(folder / "brick.stl")
    (folder / "toys").mkdir()
    trimesh.creation.icosphere(subdivisions=2, radius=0.02).export(folder / "toys" / "ball.ply")
    trimesh.creation.cylinder(radius=0.015, height=0.06).export(folder / "toys" / "rod.obj")
    (folder / "toys" / "torn.off").write_text("OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n")
    return folder


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Supervisor]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("service"), port=0, device="cpu")
    with Supervisor(settings, workers=1) as supervisor:
        supervisor.wait_ready(PATIENCE_S)
        until_a_worker_is_idle(supervisor.api_url)
        yield supervisor


@pytest.fixture(autouse=True)
def user(service: Supervisor, files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands are typed in the folder of the files, and reach the service."""
    monkeypatch.setenv("GRASPD_API_URL", service.api_url)
    monkeypatch.setenv("GRASPD_DATA_DIR", str(service.settings.data_dir))
    monkeypatch.chdir(files)


def test_a_refused_object_gets_in_with_the_named_fix() -> None:
    assert "--units mm" in refused("objects add brick.stl")
    brick = graspd("objects add brick.stl --units mm --density 500")
    assert brick["verdict"] == "accept"
    assert brick["facts"]["mass_kg"] == pytest.approx(60e-3 * 40e-3 * 30e-3 * 500, rel=1e-3)


def test_a_folder_of_objects_becomes_a_dataset_and_files(service: Supervisor, tmp_path: Path) -> None:
    hand = graspd("hands add pincer.urdf --no-self-test")
    assert (hand["name"], hand["verdict"]) == ("pincer", "accept")
    assert hand["facts"]["palm_approach"] == [0.0, 0.0, 1.0]
    wanted = "datasets create play --hands pincer --objects toys --grasps 4"
    cheap = "--fidelity draft --want candidates --validation none"
    seen = graspd(f"{wanted} {cheap} --dry-run")
    assert seen["estimate"]["cells"] == 3 and "dataset" not in seen
    made = graspd(f"{wanted} {cheap} --yes --wait")
    assert (made["dataset"]["state"], made["dataset"]["grasps"]) == ("succeeded", 8)
    assert made["refused"] == ["torn"]
    states = {cell["object"]: cell["state"] for cell in graspd("datasets status play")["matrix"]}
    assert states == {"ball": "succeeded", "rod": "succeeded"}
    export = graspd("datasets export play -o", tmp_path / "play")
    assert export["complete"]
    assert len(list((tmp_path / "play").rglob("*.h5"))) == export["files"] == 2
    settings = service.settings
    index = Index(settings.resolved_index_url)
    assert differences(index, open_store(settings.resolved_store_url)) == []
    index.close()
