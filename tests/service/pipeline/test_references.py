"""Neighbours and networks of jobs and datasets: which files they are, what is refused, and what may not be deleted."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
from pydantic import ValidationError

from graspd.service.index.queries.grasps import GraspFilter
from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.errors import ConflictError, InputError, NotFoundError, SceneError
from graspd.service.model.messages import TaskMessage
from graspd.service.model.planning import create_task_message, plan_tasks
from graspd.service.model.records import JobRecord
from graspd.service.model.states import AssetKind, Stage
from graspd.service.model.version import OLDEST_TASK_SCHEMA, SCHEMA_OF_NETWORKS
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.deletion import GarbageCollector, delete_asset, delete_dataset, delete_job
from graspd.service.store.network_file import check_network
from tests.api.factories import fail
from tests.fakes import make_task, plan_all, put_asset, record_of, request
from tests.networks import network_files, random_network

FLOOR = {"kind": "half_space"}
UPRIGHT = [1.0, 0, 0, 0]


def add_cup(services: Services, version: int = 0, *, verdict: str | None = "accept", **facts: Any) -> str:
    files = {"asset.json": b'{"file": "a.stl"}', "a.stl": f"solid cup{version}\nendsolid\n".encode()}
    check = {"verdict": verdict, "message": "it is none", "repairs": [], "facts": facts} if verdict else None
    return put_asset(services, AssetKind.OBJECT, "cup", files, check)


def add_network(services: Services, version: int = 0, *, verdict: str | None = "accept") -> str:
    digest = services.index.assets.get(AssetKind.HAND, "gripper").digest
    files = network_files(random_network(hand="gripper", digest=digest, seed=version))
    check = check_network(files, "net") | {"verdict": verdict, "message": "it is none"} if verdict else None
    return put_asset(services, AssetKind.NETWORK, "net", files, check)


@dataclass(frozen=True)
class Reference:
    kind: AssetKind
    name: str
    add: Callable[..., str]
    options: dict[str, Any]

    def submit(self, services: Services, **changes: Any) -> JobRecord:
        job, _ = job_actions.submit(services, request(**{**self.options, **changes}))
        return record_of(services, job.id)


NEIGHBOUR = Reference(AssetKind.OBJECT, "cup", add_cup, {"scene": "table", "neighbours": ("cup",)})
LEARNED = {"scene": "table", "method": "learned"}
NETWORK = Reference(AssetKind.NETWORK, "net", add_network, {**LEARNED, "options": {"network": "net"}})
BOTH = pytest.mark.parametrize("named", [NEIGHBOUR, NETWORK], ids=lambda one: one.name)


def dataset_of(named: Reference, **changes: Any) -> DatasetRequest:
    given: Any = {"name": "d", "hands": ("gripper",), "objects": ("ball",), "grasps": 64, **named.options}
    return DatasetRequest(**given | changes)


def grasps_of(job: JobRecord) -> str:
    return next(task.output for task in plan_tasks(job) if task.stage is Stage.SYNTHESIZE)


@BOTH
def test_a_job_keeps_the_very_files_that_it_named(services: Services, named: Reference) -> None:
    digest = named.add(services)
    job = named.submit(services)
    assert (named.kind, digest) in job.assets
    assert named.submit(services).id == job.id
    newer = named.add(services, 1)
    later = named.submit(services)
    assert newer != digest and later.id != job.id and grasps_of(later) != grasps_of(job)
    # The request of the first job, as its page tells it, is still that job.
    assert named.submit(services, **job.request.model_dump(exclude={"hand", "object"})).id == job.id


@BOTH
def test_what_is_named_is_needed_until_its_users_are_deleted(services: Services, named: Reference) -> None:
    named.add(services)
    job = named.submit(services).id
    actions.create(services, dataset_of(named))
    with pytest.raises(ConflictError, match=f"the {named.kind.value} {named.name!r} is needed by job {job}"):
        delete_asset(services, named.kind, named.name)
    job_actions.cancel(services, job)
    delete_job(services, job)
    with pytest.raises(ConflictError, match="needed by dataset 'd'"):
        delete_asset(services, named.kind, named.name)
    actions.cancel(services, "d")
    plan_all(services)
    delete_dataset(services, "d")
    delete_asset(services, named.kind, named.name)
    with pytest.raises(NotFoundError, match=f"there is no {named.kind.value} {named.name!r}"):
        named.submit(services)
    while GarbageCollector(services).execute_deletions():
        pass
    assert not list(services.store.list(f"{names.ASSETS}/network"))


@BOTH
def test_a_job_entered_while_it_is_deleted_is_not_kept(services: Services, named: Reference) -> None:
    named.add(services)
    record = job_actions.prepare_job(services, request(**named.options))
    delete_asset(services, named.kind, named.name)
    with pytest.raises(NotFoundError, match=rf"{named.kind.value} .* deleted just now"):
        job_actions.enter_job(services, record)
    assert list(services.store.list(names.JOBS)) == []


@BOTH
def test_a_dataset_hands_it_on_to_each_job(services: Services, named: Reference) -> None:
    digest = named.add(services)
    assert actions.create(services, dataset_of(named))[1]
    plan_all(services)
    (job,) = services.index.jobs.page().items
    assert (named.kind, digest) in record_of(services, job.id).assets
    assert differences(services.index, services.store) == []
    assert actions.create(services, dataset_of(named))[1] is False, "the same again is the same dataset"
    named.add(services, 1)
    with pytest.raises(ConflictError, match=r"its (neighbours|options) is"):
        actions.create(services, dataset_of(named))


@BOTH
@pytest.mark.parametrize(
    ("verdict", "error", "words"),
    [("refuse", InputError, "was refused: it is none"), (None, ConflictError, "still being checked")],
)
def test_what_was_not_found_good_is_used_by_no_job(
    services: Services, named: Reference, verdict: str | None, error: type[Exception], words: str
) -> None:
    named.add(services, verdict=verdict)
    with pytest.raises(error, match=words):
        named.submit(services)


NO_NETWORKS = ("net", "../../jobs", "F" * 32, "a" * 31, "a" * 32 + "\n", "")
NO_NEIGHBOURS = ({"object": "cup"}, {"object": "../x", "digest": "a" * 32}, {"object": "cup", "digest": "../x"})


@pytest.mark.parametrize(
    ("named", "forged"),
    [
        *((NETWORK, {"options": {"network": one}}) for one in NO_NETWORKS),
        *((NEIGHBOUR, {"neighbours": [one]}) for one in NO_NEIGHBOURS),
    ],
)
def test_a_forged_entry_needs_a_digest(services: Services, named: Reference, forged: dict[str, Any]) -> None:
    named.add(services)
    job = named.submit(services)
    said = create_task_message(job, next(plan_tasks(job)), attempt=1, max_attempt=3).model_dump(
        mode="json", by_alias=True
    )
    assert TaskMessage.model_validate(said).request == job.request
    with pytest.raises(ValidationError):
        TaskMessage.model_validate({**said, "request": {**said["request"], **forged}})


@pytest.mark.parametrize("other", [("cup",), ("ball", "cup"), ()])
def test_other_neighbours_or_another_order_are_other_scenes(services: Services, other: tuple[str, ...]) -> None:
    cup = add_cup(services)
    known = NEIGHBOUR.submit(services, neighbours=("cup", "ball"))
    assert [one.digest for one in known.request.scene_spec.neighbours] == [cup, known.object_digest]
    assert next(plan_tasks(NEIGHBOUR.submit(services, neighbours=other))).output != next(plan_tasks(known)).output


def test_a_document_places_its_neighbours(services: Services) -> None:
    cup = add_cup(services)
    places = [{"object": "cup", "pose": [0.2, 0, 0, *UPRIGHT]}, {"object": "cup", "pose": [-0.2, 0, 0, *UPRIGHT]}]
    scene = {"supports": [FLOOR], "target": [0, 0, 0, *UPRIGHT], "neighbours": places}
    found = NEIGHBOUR.submit(services, scene=scene, neighbours=()).request.scene_spec.neighbours
    assert [one.pose and one.pose[0] for one in found] == [0.2, -0.2]
    assert {one.digest for one in found} == {cup}


def test_a_rebuilt_index_knows_the_same_of_neighbours(services: Services) -> None:
    add_cup(services)
    job = NEIGHBOUR.submit(services)
    for stage in (Stage.SCENE, Stage.SYNTHESIZE):
        make_task(services, job, next(task for task in plan_tasks(job) if task.stage is stage))
    assert differences(services.index, services.store) == []
    found = services.index.grasps.page(GraspFilter(neighbours=True), limit=200).items
    assert len(found) == 32 and {grasp.neighbours for grasp in found} == {1}
    assert services.index.grasps.page(GraspFilter(neighbours=False), limit=200).items == []


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"neighbours": ({"object": "ball", "digest": "a" * 32},)}, NotFoundError, "there is no object"),
        ({"neighbours": ({"object": "cap", "digest": "cup"},)}, InputError, "has the digest of 'cup'"),
        (
            {"scene": {"supports": [FLOOR], "neighbours": [{"object": "cup", "pose": [0, 0, -0.2, *UPRIGHT]}]}},
            SceneError,
            "cup penetrates support 0 of its scene: its centre is 200 mm inside; move the neighbour",
        ),
    ],
)
def test_what_cannot_stand_there_is_told_before_any_work(
    services: Services, changes: dict[str, Any], error: type[Exception], words: str
) -> None:
    cup = add_cup(services, centre_of_mass_m=[0.0, 0.0, 0.0])
    changes = json.loads(json.dumps(changes).replace('"digest": "cup"', f'"digest": "{cup}"'))
    with pytest.raises(error, match=words):
        NEIGHBOUR.submit(services, **{"neighbours": (), **changes})
    assert services.index.jobs.page().items == []


def test_a_job_without_neighbours_needs_no_other_object(services: Services) -> None:
    add_cup(services)
    job = NEIGHBOUR.submit(services, neighbours=())
    assert job.assets == ((AssetKind.HAND, job.hand_digest), (AssetKind.OBJECT, job.object_digest))
    assert "neighbours" not in job.request.model_dump()
    delete_asset(services, AssetKind.OBJECT, "cup")


def test_another_network_changes_the_grasps_and_not_the_scenes(services: Services) -> None:
    net = add_network(services)
    job = NETWORK.submit(services, options={"network": "net", "starts": 2})
    assert job.request.options == {"network": net, "starts": 2}
    assert NETWORK.submit(services, options={"network": net, "starts": 2}).id == job.id
    add_network(services, 1)
    later = NETWORK.submit(services, options={"network": "net", "starts": 2})
    assert next(plan_tasks(later)).output == next(plan_tasks(job)).output and grasps_of(later) != grasps_of(job)


def test_a_retried_job_sets_out_from_the_network_it_had(services: Services) -> None:
    net = add_network(services)
    job = NETWORK.submit(services)
    fail(services, job, "it broke")
    add_network(services, 1)
    queue: Any = services.queue
    queue.finish(queue.take("w"))
    job_actions.retry(services, job.id)
    assert queue.take("w").message.request.network == net


def test_workers_that_know_networks_are_asked_for_one_of_this_method(services: Services) -> None:
    add_network(services)
    jobs = NETWORK.submit(services), NETWORK.submit(services, method="fast_graspd", options={})
    asked = [create_task_message(job, next(plan_tasks(job)), attempt=1, max_attempt=3).schema_ for job in jobs]
    assert asked == [SCHEMA_OF_NETWORKS, OLDEST_TASK_SCHEMA]
    job = NETWORK.submit(services, method="mine", options={"network": "what I call so"})
    assert job.request.options == {"network": "what I call so"} and len(job.assets) == 2
