"""The real engine in real workers, killed in the middle of its work."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from service.index.rebuild import differences
from service.model.domain import AssetKind, JobRequest, State
from service.store.shards import read_shard
from tests.system.conftest import System
from worker.certified import certified_grasps
from worker.hands.load import hand_from_path
from worker.objects.prepare import object_from_path

pytestmark = pytest.mark.chaos


def test_a_worker_killed_in_mid_synthesis_leaves_the_same_grasps(start: Callable[..., System]) -> None:
    system = start(fakes=False, lease_s=2.0, retry_backoff_s=0.1)
    index = system.parts.index
    request = JobRequest(hand="barrett", object="block", grasps=24, fidelity="draft", seed=7)
    system.until(
        lambda: {a.name for kind in AssetKind for a in index.assets.page(kind=kind).items} >= {"barrett", "block"},
        20, "the built-in assets are published",
    )  # fmt: skip
    job = system.submit(request)
    system.until(
        lambda: any(0 < task.done < 0.9 * task.total for task in index.jobs.tasks(job=job, state=State.RUNNING).items),
        60, "the synthesis is under way",
    )  # fmt: skip
    system.kill("worker-0")
    (done,) = system.finish(job, seconds=90)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 24)
    assert [attempt.kind for attempt in index.jobs.attempts(job=job)] == ["WorkerLost"]
    (shard,) = index.shards.page(job=job, kind="base").items
    kept = read_shard(system.parts.store.get(shard.key))
    undisturbed = certified_grasps(
        hand_from_path("barrett"), object_from_path("block", face_error_m=request.knobs.face_error_m), request, count=24
    ).grasps
    np.testing.assert_array_equal(kept["grasp/hand_pose"], undisturbed.grasp.hand_pose)
    np.testing.assert_array_equal(kept["grasp/joint_positions"], undisturbed.grasp.joint_positions)
    assert differences(index, system.parts.store) == []
