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
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_bytes, job_id
from graspd.service.model.domain import Asset, JobOptions, JobRequest
from graspd.service.model.messages import IngestMessage
from graspd.service.model.planning import message_of, plan
from graspd.service.model.records import JobRecord
from graspd.service.model.scene_spec import has_table, scene_of
from graspd.service.model.states import AssetKind, Priority, Stage
from graspd.service.queue.port import EventKind
from graspd.service.store.assets import builtin_files, pack
from graspd.service.store.library import load_check, publish_asset
from graspd.service.store.manifests import load_shard
from graspd.service.store.network_file import NETWORK_FILE, check_network
from graspd.service.store.store import Store, open_store
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.synthesis import synthesized
from graspd.worker.hands.load import hand_from_path
from graspd.worker.planners import known_networks as known
from graspd.worker.planners.registry import of_this_machine
from graspd.worker.process.runner import Runner
from graspd.worker.scenes.kinds import supports_of
from graspd.worker.stages import assets, ingest, scene, synthesize
from graspd.worker.stages.context import TaskContext
from tests.networks import LEARNED, network_files, random_network


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


def job_of(store: Store, **options: Any) -> JobRecord:
    hand = publish_asset(store, AssetKind.HAND, "barrett", builtin_files(AssetKind.HAND, "barrett"))
    obj = publish_asset(store, AssetKind.OBJECT, "block", builtin_files(AssetKind.OBJECT, "block"))
    wanted = JobRequest(hand="barrett", object="block", **LEARNED, options=options)
    return JobRecord(
        id=job_id(wanted, hand.digest, obj.digest),
        request=wanted,
        hand_digest=hand.digest,
        object_digest=obj.digest,
        priority=Priority.BULK,
        created=timestamp(),
    )


def end_of(store: Store, job: JobRecord) -> tuple[EventKind, str]:
    """Kind and words of the end of a job's batch on one worker."""
    runner = Runner({Stage.SCENE: scene.run, Stage.SYNTHESIZE: synthesize.run}, worker="w", publish=lambda event: None)  # type: ignore[arg-type]
    for task in plan(job):
        message = message_of(job, task, attempt=1, max_attempt=3).model_dump(mode="json", by_alias=True)
        event = runner.run(message, TaskContext(store, ExecutionContext(threads=2)))
        assert event is not None
        if event.kind is not EventKind.FINISHED:
            break
    return event.kind, event.message


def test_the_grasps_of_a_job_are_those_of_synth_with_the_file(
    store: Store, network: Asset, files: dict[str, bytes], tmp_path: Path
) -> None:
    job = job_of(store, network=network.digest, starts=2)
    assert end_of(store, job) == (EventKind.FINISHED, "")
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


def test_files_in_the_store_that_are_not_what_their_digest_says_fail_the_job_in_a_line(
    store: Store, network: Asset, files: dict[str, bytes]
) -> None:
    key = names.asset_files(AssetKind.NETWORK, network.digest)
    store.delete(key)
    store.put(key, pack(files | {NETWORK_FILE: files[NETWORK_FILE][:-1]}))
    kind, words = end_of(store, job_of(store, network=network.digest))
    assert kind is EventKind.FAILED and "\n" not in words
    assert f"network {network.digest} in the store is damaged" in words


def test_a_network_that_is_not_in_the_store_fails_the_job_in_a_line(store: Store, network: Asset) -> None:
    kind, words = end_of(store, job_of(store, network="e" * 32))
    assert kind is not EventKind.FINISHED and "\n" not in words and "e" * 32 in words


def test_a_worker_reads_a_network_once(store: Store, network: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    job = job_of(store, network=network.digest)
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
def test_a_scene_is_refused_at_the_door_where_the_planner_finds_no_table(scene: Any) -> None:
    place = JobOptions(scene=scene).place
    assert place == scene_of(JobOptions(scene=scene).scene, faces="drawn", touch=0.0, beside=())
    try:
        table_height(supports_of(place))
    except Exception:
        assert not has_table(place)
    else:
        assert has_table(place)
