"""Neighbours of jobs and datasets: which files they are, what stands for what, and what may not be deleted."""

from __future__ import annotations

import json
from typing import Any

import pytest
from pydantic import ValidationError

from graspd.service.index.queries.grasps import GraspFilter
from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.errors import ConflictError, InputError, NotFoundError, SceneError
from graspd.service.model.messages import TaskMessage
from graspd.service.model.planning import message_of, plan
from graspd.service.model.records import JobRecord
from graspd.service.model.states import AssetKind, Stage
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.deletion import delete_asset
from graspd.service.store.library import publish_asset
from tests.fakes import make_task, record_of, request
from tests.planning import plan_all
from tests.service.pipeline.needed import needed_until_its_users_are_deleted

FLOOR = {"kind": "half_space"}
UPRIGHT = [1.0, 0, 0, 0]


def add(services: Services, name: str, *, words: str = "", **facts: Any) -> str:
    """An object that was found good; its digest."""
    files = {"asset.json": b'{"file": "a.stl"}', "a.stl": f"solid {name}{words}\nendsolid\n".encode()}
    asset = publish_asset(services.store, AssetKind.OBJECT, name, files)
    check = {"verdict": "accept", "message": "fine", "repairs": [], "facts": facts}
    services.store.put(names.asset_check(AssetKind.OBJECT, asset.digest), json.dumps(check).encode())
    services.index.write.add_asset(asset, check)
    return asset.digest


def submit(services: Services, **changes: Any) -> JobRecord:
    return record_of(services, job_actions.submit(services, request(**{"scene": "table", **changes}))[0].id)


def dataset_of(**changes: Any) -> DatasetRequest:
    given: Any = {"name": "d", "hands": ("gripper",), "objects": ("ball",), "grasps": 32, "neighbours": ("cup",)}
    return DatasetRequest(**given | changes)


def test_a_job_keeps_the_very_files_of_its_neighbours(services: Services) -> None:
    cup = add(services, "cup")
    job = submit(services, neighbours=("cup", "ball"))
    assert [(one.object, one.digest) for one in job.request.beside] == [("cup", cup), ("ball", job.object_digest)]
    assert [one.digest for one in job.request.place.neighbours] == [cup, job.object_digest]
    assert submit(services, neighbours=("cup", "ball")).id == job.id
    first = next(plan(job)).output
    newer = add(services, "cup", words="!")
    later = submit(services, neighbours=("cup", "ball"))
    assert newer != cup and later.id != job.id and next(plan(later)).output != first
    # The request of the first job, as its page tells it, is still that job.
    assert submit(services, **job.request.model_dump(exclude={"hand", "object"})).id == job.id


@pytest.mark.parametrize("other", [{"neighbours": ("cup",)}, {"neighbours": ("ball", "cup")}, {}])
def test_other_neighbours_or_another_order_are_other_scenes(services: Services, other: dict[str, Any]) -> None:
    add(services, "cup")
    known = submit(services, neighbours=("cup", "ball"))
    assert next(plan(submit(services, **other))).output != next(plan(known)).output


def test_a_document_places_its_neighbours(services: Services) -> None:
    cup = add(services, "cup")
    places = [{"object": "cup", "pose": [0.2, 0, 0, *UPRIGHT]}, {"object": "cup", "pose": [-0.2, 0, 0, *UPRIGHT]}]
    job = submit(services, scene={"supports": [FLOOR], "target": [0, 0, 0, *UPRIGHT], "neighbours": places})
    found = job.request.place.neighbours
    assert [one.pose and one.pose[0] for one in found] == [0.2, -0.2]
    assert {one.digest for one in found} == {cup}


def test_a_neighbour_is_needed_until_its_users_are_deleted(services: Services) -> None:
    add(services, "cup")
    job = submit(services, neighbours=("cup",))
    needed_until_its_users_are_deleted(services, AssetKind.OBJECT, "cup", job.id, dataset_of(scene="bin"))
    with pytest.raises(NotFoundError, match="there is no object 'cup'"):
        submit(services, neighbours=("cup",))


def test_a_dataset_hands_its_neighbours_on_to_each_job(services: Services) -> None:
    cup = add(services, "cup")
    wanted = dataset_of(objects=("ball", "cup"), scene="table")
    made, new = actions.create(services, wanted)
    assert new and made.options.beside[0].digest == cup
    plan_all(services)
    jobs = services.index.jobs.page().items
    assert len(jobs) == 2 and all(job.request.beside[0].digest == cup for job in jobs)
    assert actions.create(services, wanted)[1] is False, "the same again is the same dataset"
    with pytest.raises(ConflictError, match="its neighbours is cup"):
        actions.create(services, wanted.model_copy(update={"neighbours": ()}))


def test_a_rebuilt_index_knows_the_same_of_neighbours(services: Services) -> None:
    add(services, "cup")
    job = submit(services, neighbours=("cup",))
    for stage in (Stage.SCENE, Stage.SYNTHESIZE):
        make_task(services, job, next(task for task in plan(job) if task.stage is stage))
    assert differences(services.index, services.store) == []
    found = services.index.grasps.page(GraspFilter(neighbours=True), limit=200).items
    assert len(found) == 32 and {grasp.neighbours for grasp in found} == {1}
    assert services.index.grasps.page(GraspFilter(neighbours=False), limit=200).items == []


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"neighbours": ("nothing",)}, NotFoundError, "there is no object 'nothing'"),
        ({"neighbours": ({"object": "ball", "digest": "a" * 32},)}, NotFoundError, "there is no object"),
        ({"neighbours": ({"object": "cap", "digest": "cup"},)}, InputError, "digest that is of 'cup'"),
        (
            {"scene": {"supports": [FLOOR], "neighbours": [{"object": "cup", "pose": [0, 0, -0.2, *UPRIGHT]}]}},
            SceneError,
            "cup stands in support 0 of its scene: its centre lies 200 mm deep; move the neighbour",
        ),
    ],
)
def test_what_cannot_stand_there_is_told_before_any_work(
    services: Services, changes: dict[str, Any], error: type[Exception], words: str
) -> None:
    cup = add(services, "cup", centre_of_mass_m=[0.0, 0.0, 0.0])
    for one in changes.get("neighbours", ()):
        if isinstance(one, dict) and one["digest"] == "cup":
            one["digest"] = cup
    with pytest.raises(error, match=words):
        submit(services, **changes)
    assert services.index.jobs.page().items == []


def test_a_neighbour_that_is_being_checked_is_waited_for(services: Services) -> None:
    files = {"asset.json": b'{"file": "a.stl"}', "a.stl": b"solid\nendsolid\n"}
    services.index.write.add_asset(publish_asset(services.store, AssetKind.OBJECT, "cup", files), None)
    with pytest.raises(ConflictError, match="still being checked"):
        submit(services, neighbours=("cup",))


def test_a_forged_entry_cannot_name_a_neighbour_by_name_alone(services: Services) -> None:
    add(services, "cup")
    job = submit(services, neighbours=("cup",))
    said = message_of(job, next(plan(job)), attempt=1, max_attempt=3).model_dump(mode="json", by_alias=True)
    assert TaskMessage.model_validate(said).request == job.request
    for forged in ({"object": "cup"}, {"object": "../cup", "digest": "a" * 32}, {"object": "cup", "digest": "../x"}):
        with pytest.raises(ValidationError):
            TaskMessage.model_validate({**said, "request": {**said["request"], "neighbours": [forged]}})


def test_a_job_without_neighbours_needs_no_other_object(services: Services) -> None:
    add(services, "cup")
    job = submit(services)
    assert job.assets == ((AssetKind.HAND, job.hand_digest), (AssetKind.OBJECT, job.object_digest))
    assert "neighbours" not in job.request.model_dump()
    delete_asset(services, AssetKind.OBJECT, "cup")
