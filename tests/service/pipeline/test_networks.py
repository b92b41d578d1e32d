"""Networks of jobs and datasets: which files they are, whose grasps they propose, and what may not be deleted."""

from __future__ import annotations

import json
from typing import Any

import pytest
from pydantic import ValidationError

from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.errors import ConflictError, InputError, NotFoundError
from graspd.service.model.messages import TaskMessage
from graspd.service.model.planning import message_of, plan
from graspd.service.model.records import JobRecord
from graspd.service.model.states import AssetKind, Stage
from graspd.service.model.version import OLDEST_TASK_SCHEMA, SCHEMA_OF_NETWORKS
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.deletion import delete_asset
from graspd.service.pipeline.garbage_collector import GarbageCollector
from graspd.service.store.library import publish_asset
from graspd.service.store.network_file import check_network
from tests.api.factories import fail
from tests.fakes import record_of, request
from tests.networks import network_files, random_network
from tests.planning import plan_all
from tests.service.pipeline.needed import needed_until_its_users_are_deleted

LEARNED = {"scene": "table", "method": "learned"}
NAMED = {"options": {"network": "net"}}


def add(services: Services, name: str = "net", *, seed: int = 0, hand: str = "gripper", **finding: Any) -> str:
    """A network of a hand, found good; its digest."""
    digest = services.index.assets.get(AssetKind.HAND, "gripper").digest if hand == "gripper" else "f" * 32
    files = network_files(random_network(hand=hand, digest=digest, seed=seed))
    asset = publish_asset(services.store, AssetKind.NETWORK, name, files)
    check = check_network(files, name) | finding
    services.store.put(names.asset_check(AssetKind.NETWORK, asset.digest), json.dumps(check).encode())
    services.index.write.add_asset(asset, check)
    return asset.digest


def submit(services: Services, **changes: Any) -> JobRecord:
    return record_of(services, job_actions.submit(services, request(**{**LEARNED, **NAMED, **changes}))[0].id)


def grasps_of(job: JobRecord) -> str:
    return next(task.output for task in plan(job) if task.stage is Stage.SYNTHESIZE)


def test_a_job_keeps_the_very_file_of_its_network(services: Services) -> None:
    net = add(services)
    job = submit(services, options={"network": "net", "starts": 2})
    assert job.request.options == {"network": net, "starts": 2}
    assert (AssetKind.NETWORK, net) in job.assets
    for said in ("net", net):
        assert submit(services, options={"network": said, "starts": 2}).id == job.id
    newer = add(services, seed=1)
    later = submit(services, options={"network": "net", "starts": 2})
    assert newer != net and later.id != job.id and grasps_of(later) != grasps_of(job)
    assert next(plan(later)).output == next(plan(job)).output, "the scenes are the same"
    # The request of the first job, as its page tells it, is still that job.
    assert submit(services, **job.request.model_dump(exclude={"hand", "object"})).id == job.id


def test_a_retried_job_sets_out_from_the_network_it_had(services: Services) -> None:
    net = add(services)
    job = submit(services)
    fail(services, job, "it broke")
    add(services, seed=1)
    queue: Any = services.queue
    queue.finish(queue.take("w"))
    job_actions.retry(services, job.id)
    assert queue.take("w").message.request.network == net


def test_a_network_is_needed_until_its_users_are_deleted(services: Services) -> None:
    add(services)
    job = submit(services)
    wanted = DatasetRequest(name="d", hands=("gripper",), objects=("ball",), grasps=64, **LEARNED, **NAMED)
    needed_until_its_users_are_deleted(services, AssetKind.NETWORK, "net", job.id, wanted)
    with pytest.raises(NotFoundError, match="there is no network 'net'"):
        submit(services)
    while GarbageCollector(services).advance():
        pass
    assert [entry.key for entry in services.store.list(f"{names.ASSETS}/network")] == []


def test_a_job_entered_while_its_network_is_deleted_is_not_kept(services: Services) -> None:
    add(services)
    record = job_actions.prepare(services, request(**LEARNED, **NAMED))
    delete_asset(services, AssetKind.NETWORK, "net")
    with pytest.raises(NotFoundError, match=r"network .* deleted just now"):
        job_actions.enter(services, record)
    assert list(services.store.list(names.JOBS)) == []


def test_a_dataset_hands_its_network_on_to_each_job(services: Services) -> None:
    net = add(services)
    wanted = DatasetRequest(name="d", hands=("gripper",), objects=("ball",), **LEARNED, **NAMED)
    made, new = actions.create(services, wanted)
    assert new and made.options.network == net
    plan_all(services)
    assert [job.request.network for job in services.index.jobs.page().items] == [net]
    assert differences(services.index, services.store) == []
    assert actions.create(services, wanted)[1] is False, "the same again is the same dataset"
    add(services, seed=1)
    with pytest.raises(ConflictError, match="its options is"):
        actions.create(services, wanted)


def test_a_network_of_another_hand_is_refused_in_a_line(services: Services) -> None:
    add(services, hand="claw")
    words = r"network 'net' proposes grasps of claw \(f{12}\), not of gripper \([0-9a-f]{12}\)"
    with pytest.raises(InputError, match=words):
        submit(services)
    wanted = DatasetRequest(name="d", hands=("gripper",), objects=("ball",), **LEARNED, **NAMED)
    with pytest.raises(InputError, match=words):
        actions.create(services, wanted)
    assert services.index.jobs.page().items == [] and services.index.datasets.page().items == []


def test_a_network_that_was_refused_is_used_by_no_job(services: Services) -> None:
    add(services, verdict="refuse", message="it is none")
    with pytest.raises(InputError, match="network 'net' was refused: it is none"):
        submit(services)


@pytest.mark.parametrize("forged", ["net", "../../jobs", "F" * 32, "a" * 31, "a" * 32 + "\n", ""])
def test_a_forged_entry_cannot_name_a_network_without_its_digest(services: Services, forged: str) -> None:
    add(services)
    job = submit(services)
    said = message_of(job, next(plan(job)), attempt=1, max_attempt=3).model_dump(mode="json", by_alias=True)
    assert TaskMessage.model_validate(said).request == job.request
    with pytest.raises(ValidationError):
        TaskMessage.model_validate({**said, "request": {**said["request"], "options": {"network": forged}}})


def test_only_workers_that_know_networks_are_asked_for_one(services: Services) -> None:
    add(services)
    asked = [
        message_of(job, next(plan(job)), attempt=1, max_attempt=3).schema_
        for job in (submit(services), submit(services, method="fast_graspd", options={}))
    ]
    assert asked == [SCHEMA_OF_NETWORKS, OLDEST_TASK_SCHEMA]


def test_an_option_of_another_method_is_no_network(services: Services) -> None:
    job = submit(services, method="mine", options={"network": "what I call so"})
    assert job.request.options == {"network": "what I call so"} and len(job.assets) == 2
