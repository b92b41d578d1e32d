"""The real engine in real workers: killed in the middle of its work, and given a network."""

from collections.abc import Callable

import numpy as np
import pytest

from graspd.service.index.rebuild import differences
from graspd.service.model.domain import JobRequest
from graspd.service.model.states import AssetKind, Stage, State
from graspd.service.store.shards import read_shard
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.scenes.placement import scenes_of
from tests.system.conftest import System


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
