"""The real engine in real workers: killed in the middle of its work, and given a network."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import httpx
import numpy as np
import pytest

from graspd.service.index.rebuild import differences
from graspd.service.model.domain import JobOptions, JobRequest
from graspd.service.model.states import AssetKind, Stage, State
from graspd.service.store.network_file import to_bytes
from graspd.service.store.shards import read_shard
from graspd.worker.files.synthesis import synthesized
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.registry import of_this_machine
from graspd.worker.scenes.placement import scenes_of
from tests.networks import LEARNED, random_network
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
    block = object_from_path("block", face_error_m=request.knobs.face_error_m)
    scenes = None
    if request.in_scene:
        scenes, poses = scenes_of(request.place, block, [], count=request.scenes, seed=request.seed)
        np.testing.assert_array_equal(kept["scene/object_pose"], poses["scene/object_pose"])
    undisturbed = validated_grasps(hand_from_path("barrett"), block, request, count=24, scenes=scenes).grasps
    np.testing.assert_array_equal(kept["grasp/hand_pose"], undisturbed.grasp.hand_pose)
    np.testing.assert_array_equal(kept["grasp/joint_positions"], undisturbed.grasp.joint_positions)
    assert differences(index, system.services.store) == []


@pytest.mark.chaos
@pytest.mark.slow
def test_a_job_with_a_network_gives_the_grasps_of_synth(start: Callable[..., System], tmp_path: Path) -> None:
    hand = hand_from_path("barrett")
    file = tmp_path / "net.npz"
    file.write_bytes(to_bytes(random_network(hand.joint_names, hand=hand.name, digest=hand.digest)))
    system = start(fakes=False, api=True)
    with httpx.Client(base_url=system.supervisor.api_url, trust_env=False, timeout=60) as http:
        system.until(lambda: http.get("/v1/objects/block").status_code == 200, "the built-in assets are published")
        assert http.post("/v1/networks", files={"file": (file.name, file.read_bytes())}).status_code == 201
        wanted = {"hand": "barrett", "object": "block", **LEARNED, "options": {"network": "net", "starts": 2}}
        answer = http.post("/v1/jobs", json=wanted)
        assert answer.status_code == 202, answer.text
    (done,) = system.finish(answer.json()["id"])
    assert (done.state, done.reason, done.grasps) == (State.SUCCEEDED, None, 3)
    (shard,) = system.services.index.shards.page(job=done.id, kind="base").items
    made = read_shard(system.services.store.get(shard.key))
    options = of_this_machine("learned", {"network": str(file), "starts": 2})
    request = JobOptions(**LEARNED, options=options)
    alone = synthesized("barrett", "block", request, place=request.place, scenes=2, device="cpu")
    for name in ("grasp/hand_pose", "grasp/joint_positions", "scene/object_pose", "quality/valid"):
        np.testing.assert_array_equal(made[name], alone.arrays[name], err_msg=name)
    assert differences(system.services.index, system.services.store) == []
