"""A job that sets out from a network of the store: the same grasps as from the file, on a worker that has no file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd.baselines.learned.method import table_height
from graspd.service.model import names
from graspd.service.model.digests import digest_bytes
from graspd.service.model.domain import Asset, JobOptions
from graspd.service.model.messages import IngestMessage
from graspd.service.model.planning import message_of, plan
from graspd.service.model.scene_spec import has_table, scene_of
from graspd.service.model.states import AssetKind, Stage
from graspd.service.queue.port import EventKind
from graspd.service.store.assets import pack
from graspd.service.store.library import load_check, publish_asset
from graspd.service.store.manifests import load_shard
from graspd.service.store.network_file import NETWORK_FILE, check_network
from graspd.service.store.store import Store, open_store
from graspd.worker.files.synthesis import synthesized
from graspd.worker.hands.load import hand_from_path
from graspd.worker.planners import known_networks as known
from graspd.worker.planners.registry import of_this_machine
from graspd.worker.scenes.kinds import supports_of
from graspd.worker.stages import assets, ingest
from graspd.worker.stages.context import TaskContext
from tests.networks import LEARNED, network_files, random_network
from tests.worker.stages.jobs import end_of, job_of


@pytest.fixture(scope="module")
def files() -> dict[str, bytes]:
    hand = hand_from_path("barrett")
    return network_files(random_network(hand.joint_names, hand=hand.name, digest=hand.digest))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return open_store((tmp_path / "store").as_uri())


@pytest.fixture
def network(store: Store, files: dict[str, bytes]) -> Iterator[Asset]:
    """It, in the store; this process, as a worker of another machine, knows no network."""
    known._known.clear()
    assets._cache.clear()
    yield publish_asset(store, AssetKind.NETWORK, "net", files)
    known._known.clear()
    assets._cache.clear()


def test_the_grasps_of_a_job_are_those_of_synth_with_the_file(
    store: Store, network: Asset, files: dict[str, bytes], tmp_path: Path
) -> None:
    job = job_of(store, **LEARNED, options={"network": network.digest, "starts": 2})
    end = end_of(store, job)
    assert end.kind is EventKind.FINISHED, end
    made = load_shard(store, Stage.SYNTHESIZE, list(plan(job))[-1].output)
    (tmp_path / "net.npz").write_bytes(files[NETWORK_FILE])
    own = of_this_machine("learned", {"network": str(tmp_path / "net.npz"), "starts": 2})
    assert own["network"] == digest_bytes(files[NETWORK_FILE]) != network.digest
    request = JobOptions(**LEARNED, options=own)
    alone = synthesized("barrett", "block", request, place=request.place, scenes=2, device="cpu", threads=2)
    assert set(made.arrays) == set(alone.arrays) and len(made["grasp/hand_pose"]) == 3
    for name, values in alone.arrays.items():
        np.testing.assert_array_equal(made[name], values, err_msg=name)
    without = JobOptions(**{**LEARNED, "method": "fast_graspd"})
    other = synthesized("barrett", "block", without, place=without.place, scenes=2, device="cpu", threads=2)
    assert (made["grasp/hand_pose"] != other.arrays["grasp/hand_pose"]).any(), "the network is followed"


def test_files_that_are_not_what_their_digest_says_fail_the_job(
    store: Store, network: Asset, files: dict[str, bytes]
) -> None:
    key = names.asset_files(AssetKind.NETWORK, network.digest)
    store.delete(key)
    store.put(key, pack(files | {NETWORK_FILE: files[NETWORK_FILE][:-1]}))
    for digest, told in ((network.digest, f"network {network.digest} in the store is damaged"), ("e" * 32, "e" * 32)):
        end = end_of(store, job_of(store, **LEARNED, options={"network": digest}))
        assert end.kind is not EventKind.FINISHED and "\n" not in end.message and told in end.message


def test_a_worker_reads_a_network_once(store: Store, network: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    job = job_of(store, **LEARNED, options={"network": network.digest})
    message = message_of(job, next(plan(job)), attempt=1, max_attempt=3)
    assets.keep_network(store, message)
    monkeypatch.setattr(assets, "load_asset_files", None)
    assets.keep_network(store, message)
    assert known.kept(network.digest).hand == "barrett"


def test_a_network_whose_finding_was_lost_is_checked_by_a_worker(
    store: Store, network: Asset, files: dict[str, bytes]
) -> None:
    message = IngestMessage(schema_=2, task_id="i", kind=AssetKind.NETWORK, name="net", digest=network.digest)
    ingest.run(message, TaskContext(store))
    found = load_check(store, AssetKind.NETWORK, network.digest)
    assert found == json.loads(json.dumps(check_network(files, "net")))
    assert not store.exists(names.asset_model(AssetKind.NETWORK, network.digest))


@pytest.mark.parametrize(
    "scene",
    [
        "table",
        "bin",
        "shelf",
        {"supports": [{"kind": "half_space", "normal": [0, 0, 5], "offset": 0.3}]},
        {"supports": [{"kind": "half_space", "normal": [0, 0, -1]}]},
        {"supports": [{"kind": "half_space", "normal": [0.001, 0, 1]}]},
        {"supports": [{"kind": "half_space", "normal": [0.01, 0, 1]}]},
        {"supports": [{"kind": "box", "size": [1, 1, 0.1]}]},
    ],
)
def test_scene_is_refused_at_door_where_planner_finds_no_table(scene: Any) -> None:
    place = JobOptions(scene=scene).place
    assert place == scene_of(JobOptions(scene=scene).scene, faces="drawn", touch=0.0, beside=())
    try:
        table_height(supports_of(place))
    except Exception:
        assert not has_table(place)
    else:
        assert has_table(place)
