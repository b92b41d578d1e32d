"""A network from its upload to the grasps that set out from it, through API, Redis, controller and a real worker."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import httpx
import numpy as np
import pytest

from graspd.service.index.rebuild import differences
from graspd.service.model.domain import JobOptions
from graspd.service.model.states import State
from graspd.service.store.network_file import to_bytes
from graspd.service.store.shards import read_shard
from graspd.worker.files.synthesis import synthesized
from graspd.worker.hands.load import hand_from_path
from graspd.worker.planners.registry import of_this_machine
from tests.networks import LEARNED, random_network
from tests.system.conftest import System

pytestmark = pytest.mark.chaos


@pytest.mark.slow
def test_a_job_with_an_uploaded_network_gives_the_grasps_of_synth_with_the_file(
    start: Callable[..., System], tmp_path: Path
) -> None:
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
