"""Networks of jobs and datasets: which files they are, whose grasps they propose, and what may not be deleted."""

from __future__ import annotations

import json
from typing import Any

import pytest
from pydantic import ValidationError

from service.index.rebuild import differences
from service.model import names
from service.model.errors import ConflictError, InputError, NotFoundError
from service.model.messages import TaskMessage
from service.model.planning import message_of, plan
from service.model.records import JobRecord
from service.model.states import AssetKind, Stage
from service.model.version import OLDEST_TASK_SCHEMA, SCHEMA_OF_NETWORKS
from service.pipeline import job_actions
from service.pipeline.backends import Parts
from service.pipeline.datasets import actions
from service.pipeline.datasets.spec import DatasetRequest
from service.pipeline.deletion import delete_asset
from service.pipeline.garbage_collector import GarbageCollector
from service.store.library import publish_asset
from service.store.network_check import check_network
from service.store.records import read_record
from tests.api.factories import fail
from tests.fakes import request
from tests.networks import network_files, random_network
from tests.planning import plan_all
from tests.service.pipeline.needed import needed_until_its_users_are_deleted

LEARNED = {"scene": "table", "method": "learned"}
NAMED = {"options": {"network": "net"}}


def add(parts: Parts, name: str = "net", *, seed: int = 0, hand: str = "gripper", **finding: Any) -> str:
    """A network of a hand, found good; its digest."""
    digest = parts.index.assets.get(AssetKind.HAND, "gripper").digest if hand == "gripper" else "f" * 32
    files = network_files(random_network(hand=hand, digest=digest, seed=seed))
    asset = publish_asset(parts.store, AssetKind.NETWORK, name, files)
    check = check_network(files, name) | finding
    parts.store.put(names.asset_check(AssetKind.NETWORK, asset.digest), json.dumps(check).encode())
    parts.index.write.add_asset(asset, check)
    return asset.digest


def submit(parts: Parts, **changes: Any) -> JobRecord:
    job, _ = job_actions.submit(parts, request(**{**LEARNED, **NAMED, **changes}))
    return read_record(JobRecord, parts.store, names.job_record(job.id))


def grasps_of(job: JobRecord) -> str:
    return next(task.output for task in plan(job) if task.stage is Stage.SYNTHESIZE)


def test_a_job_keeps_the_very_file_of_its_network(parts: Parts) -> None:
    net = add(parts)
    job = submit(parts, options={"network": "net", "starts": 2})
    assert job.request.options == {"network": net, "starts": 2}
    assert (AssetKind.NETWORK, net) in job.assets
    for said in ("net", net):
        assert submit(parts, options={"network": said, "starts": 2}).id == job.id
    newer = add(parts, seed=1)
    later = submit(parts, options={"network": "net", "starts": 2})
    assert newer != net and later.id != job.id and grasps_of(later) != grasps_of(job)
    assert next(plan(later)).output == next(plan(job)).output, "the scenes are the same"
    # The request of the first job, as its page tells it, is still that job.
    assert submit(parts, **job.request.model_dump(exclude={"hand", "object"})).id == job.id


def test_a_retried_job_sets_out_from_the_network_it_had(parts: Parts) -> None:
    net = add(parts)
    job = submit(parts)
    fail(parts, job, "it broke")
    add(parts, seed=1)
    queue: Any = parts.queue
    queue.finish(queue.take("w"))
    job_actions.retry(parts, job.id)
    assert queue.take("w").message.request.network == net


def test_a_network_is_needed_until_its_job_and_its_dataset_are_deleted(parts: Parts) -> None:
    add(parts)
    job = submit(parts)
    wanted = DatasetRequest(name="d", hands=("gripper",), objects=("ball",), grasps=64, **LEARNED, **NAMED)
    needed_until_its_users_are_deleted(parts, AssetKind.NETWORK, "net", job.id, wanted)
    with pytest.raises(NotFoundError, match="there is no network 'net'"):
        submit(parts)
    while GarbageCollector(parts).advance():
        pass
    assert [entry.key for entry in parts.store.list(f"{names.ASSETS}/network")] == []


def test_a_job_entered_while_its_network_is_deleted_is_not_kept(parts: Parts) -> None:
    add(parts)
    record = job_actions.prepare(parts, request(**LEARNED, **NAMED))
    delete_asset(parts, AssetKind.NETWORK, "net")
    with pytest.raises(NotFoundError, match=r"network .* deleted just now"):
        job_actions.enter(parts, record)
    assert list(parts.store.list(names.JOBS)) == []


def test_a_dataset_hands_its_network_on_to_each_job(parts: Parts) -> None:
    net = add(parts)
    wanted = DatasetRequest(name="d", hands=("gripper",), objects=("ball",), **LEARNED, **NAMED)
    made, new = actions.create(parts, wanted)
    assert new and made.options.network == net
    plan_all(parts)
    assert [job.request.network for job in parts.index.jobs.page().items] == [net]
    assert actions.create(parts, wanted)[1] is False, "the same again is the same dataset"
    add(parts, seed=1)
    with pytest.raises(ConflictError, match="its options is"):
        actions.create(parts, wanted)


def test_a_rebuilt_index_knows_the_same_of_networks(parts: Parts) -> None:
    add(parts)
    submit(parts)
    actions.create(parts, DatasetRequest(name="d", hands=("gripper",), objects=("ball",), **LEARNED, **NAMED))
    assert differences(parts.index, parts.store) == []


def test_a_network_of_another_hand_is_refused_in_a_line(parts: Parts) -> None:
    add(parts, hand="claw")
    words = r"network 'net' proposes grasps of claw \(f{12}\), not of gripper \([0-9a-f]{12}\)"
    with pytest.raises(InputError, match=words):
        submit(parts)
    wanted = DatasetRequest(name="d", hands=("gripper",), objects=("ball",), **LEARNED, **NAMED)
    with pytest.raises(InputError, match=words):
        actions.create(parts, wanted)
    assert parts.index.jobs.page().items == [] and parts.index.datasets.page().items == []


def test_a_network_that_was_refused_is_used_by_no_job(parts: Parts) -> None:
    add(parts, verdict="refuse", message="it is none")
    with pytest.raises(InputError, match="network 'net' was refused: it is none"):
        submit(parts)


@pytest.mark.parametrize("forged", ["net", "../../jobs", "F" * 32, "a" * 31, "a" * 32 + "\n", ""])
def test_a_forged_entry_cannot_name_a_network_without_its_digest(parts: Parts, forged: str) -> None:
    add(parts)
    job = submit(parts)
    said = message_of(job, next(plan(job)), attempt=1, max_attempt=3).model_dump(mode="json", by_alias=True)
    assert TaskMessage.model_validate(said).request == job.request
    with pytest.raises(ValidationError):
        TaskMessage.model_validate({**said, "request": {**said["request"], "options": {"network": forged}}})


def test_only_workers_that_know_networks_are_asked_for_one(parts: Parts) -> None:
    add(parts)
    asked = [message_of(job, next(plan(job)), attempt=1, max_attempt=3).schema_
             for job in (submit(parts), submit(parts, method="fast_graspd", options={}))]  # fmt: skip
    assert asked == [SCHEMA_OF_NETWORKS, OLDEST_TASK_SCHEMA]


def test_an_option_of_another_method_is_no_network(parts: Parts) -> None:
    job = submit(parts, method="mine", options={"network": "what I call so"})
    assert job.request.options == {"network": "what I call so"} and len(job.assets) == 2
