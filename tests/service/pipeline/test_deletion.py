"""What a user deletes is gone at once, from the index and from one made anew; its objects go with the controller."""

from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import pytest

from graspd.service.index.changes.removals import Removals
from graspd.service.index.database import Database
from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.errors import ConflictError, NotFoundError
from graspd.service.model.records import tag_id
from graspd.service.model.states import AssetKind, State
from graspd.service.pipeline import job_actions, tagging
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.deletion import GarbageCollector, delete_asset, delete_dataset, delete_job, restore
from graspd.service.store.library import publish_asset
from graspd.service.store.records import pending_deletions, restorable_deletions
from tests.fakes import OBJECT_FILES, finish, plan_all, record_of, request, with_settings
from tests.service.pipeline.datasets.makers import add_asset, done, fail


def finished(services: Services, **changes: Any) -> str:
    """A job whose shards are there."""
    job, _ = job_actions.submit(services, request(**changes))
    finish(services, job.id)
    return job.id


def dataset(services: Services, name: str = "d", **changes: Any) -> None:
    """A finished dataset of one cell."""
    done(services, name, hands=("gripper",), objects=("ball",), **changes)


def tag(services: Services) -> None:
    shard = next(shard.id for shard in services.index.shards.page(job=finished(services)).items if shard.kind == "base")
    tagging.tag_grasps(services, "good", [(shard, 0), (shard, 3)], project="", owner="", permit=lambda _: None)


def keys(services: Services, *prefixes: str) -> set[str]:
    return {entry.key for prefix in prefixes for entry in services.store.list(prefix)}


def graceless(services: Services) -> GarbageCollector:
    """A garbage collector to which every released shard is old."""
    return GarbageCollector(with_settings(services, shard_grace_s=-1.0))


def test_a_deleted_job_is_gone_and_its_shards_after_a_grace_time(services: Services) -> None:
    job = finished(services)
    delete_job(services, job)
    with pytest.raises(NotFoundError):
        services.index.jobs.get(job)
    assert differences(services.index, services.store) == [], "an index made anew knows it as little"
    assert not GarbageCollector(services).execute_deletions()
    assert keys(services, "jobs", "tasks", "deletions") == set()
    assert differences(services.index, services.store) == []
    assert not GarbageCollector(services).collect()
    assert len(keys(services, "shards")) == 2, "there is grace"
    assert not graceless(services).collect(budget_s=60)
    assert keys(services, "shards", "released", "removed") == set()
    assert services.index.overview.stats().grasps == 0
    assert differences(services.index, services.store) == []
    with pytest.raises(NotFoundError, match="was deleted in the last 7 days"):
        restore(services, "job", job, permit=lambda _: None)


def test_a_deleted_job_may_be_submitted_again(services: Services) -> None:
    job = finished(services)
    delete_job(services, job)
    with pytest.raises(ConflictError, match="being removed"):
        job_actions.submit(services, request())
    assert names.job_record_key(job) in keys(services, "jobs")
    GarbageCollector(services).execute_deletions()
    again, new = job_actions.submit(services, request())
    assert (again.id, new, again.state) == (job, True, State.SUCCEEDED)
    assert not graceless(services).collect(budget_s=60)
    assert len(keys(services, "shards")) == 2, "it needs them again"
    assert differences(services.index, services.store) == []


def test_what_runs_or_belongs_to_another_thing_is_in_use(services: Services) -> None:
    job, _ = job_actions.submit(services, request(seed=3))
    with pytest.raises(ConflictError, match="is queued; cancel it first"):
        delete_job(services, job.id)
    actions.create(services, DatasetRequest(name="d", hands=("gripper",), objects=("ball",)))
    with pytest.raises(ConflictError, match="cancel it first"):
        delete_dataset(services, "d")
    plan_all(services)
    (of_dataset,) = set(_jobs(services)) - {job.id}
    for one in (job.id, of_dataset):
        job_actions.cancel(services, one)
    with pytest.raises(ConflictError, match="belongs to dataset 'd'"):
        delete_job(services, of_dataset)
    delete_job(services, job.id)
    delete_dataset(services, "d")
    collect_garbage(services)
    actions.add_object_set(services, "kitchen", ["ball"])
    with pytest.raises(ConflictError, match="the set of objects 'kitchen'"):
        delete_asset(services, AssetKind.OBJECT, "ball")


def test_a_deleted_dataset_takes_its_own_jobs_with_it(services: Services) -> None:
    own = finished(services, seed=7)
    dataset(services)
    dataset(services, "other", grasps=64)
    actions.take_snapshot(services, "d")
    with pytest.raises(ConflictError, match=r"has 1 snapshot.*--with-snapshots"):
        delete_dataset(services, "d")
    assert services.index.datasets.get("d").name == "d" and not pending_deletions(services.store)
    delete_dataset(services, "d", with_snapshots=True)
    assert differences(services.index, services.store) == []
    with pytest.raises(ConflictError, match="being removed"):
        dataset(services)
    collect_garbage(services)
    assert {view.name for view in services.index.datasets.page().items} == {"other"}
    assert len(services.index.jobs.page().items) == 2
    assert services.index.jobs.get(own)
    assert keys(services, "datasets") == {names.dataset_record_key("other")}
    assert differences(services.index, services.store) == []
    dataset(services, "d", grasps=96)


@pytest.mark.parametrize("names", [["d"], ["d", "other"]])
def test_a_dataset_that_was_just_cancelled_can_be_deleted(services: Services, names: list[str]) -> None:
    """Before the planner has told its jobs; those end with it, unless another dataset waits for them."""
    for name in names:
        actions.create(services, DatasetRequest(name=name, hands=("gripper",), objects=("ball",)))
    plan_all(services)
    assert actions.cancel(services, "d").state is State.CANCELLED
    if "other" in names:
        plan_all(services)
    delete_dataset(services, "d")
    collect_garbage(services)
    assert [job.state for job in services.index.jobs.page().items] == [State.QUEUED] * (len(names) - 1)


def test_a_deleted_object_frees_its_name_and_its_files(services: Services) -> None:
    digest = services.index.assets.get(AssetKind.OBJECT, "ball").digest
    delete_asset(services, AssetKind.OBJECT, "ball")
    assert differences(services.index, services.store) == []
    with pytest.raises(ConflictError, match="being removed"):
        publish_asset(services.store, AssetKind.OBJECT, "ball", OBJECT_FILES)
    GarbageCollector(services).execute_deletions()
    assert keys(services, f"assets/object/{digest}", "deletions") == set()
    assert publish_asset(services.store, AssetKind.OBJECT, "orb", OBJECT_FILES).name == "orb"


def _jobs(services: Services) -> list[str]:
    return [job.id for job in services.index.jobs.page().items]


Act = Callable[[Services], object]
#: How it comes to be, if it is not there already, and how it is deleted.
MAKE: dict[Any, Act] = {"job": finished, "dataset": dataset, "object": lambda _: None, "tag": tag}
DELETE: dict[Any, Act] = {
    "job": lambda services: delete_job(services, _jobs(services)[0]),
    "dataset": lambda services: delete_dataset(services, "d", with_snapshots=True),
    "object": lambda services: delete_asset(services, AssetKind.OBJECT, "ball"),
    "tag": lambda services: tagging.delete_tag(services, tag_id("good", ""), permit=lambda _: None),
}
#: Where its objects lie.
FOLDERS = {"job": ["jobs"], "dataset": ["datasets", "jobs"], "object": ["assets/object"]}


@pytest.mark.parametrize("what", FOLDERS)
def test_the_next_controller_carries_out_a_broken_deletion(
    services: Services, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    remove, folders = f"remove_{what.replace('object', 'asset')}", FOLDERS[what]
    MAKE[what](services)
    with monkeypatch.context() as patch:
        patch.setattr(Removals, remove, Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            DELETE[what](services)
    assert pending_deletions(services.store)
    real, place = type(services.store).delete, 0
    while keys(services, "deletions"):
        with monkeypatch.context() as patch, pytest.raises((KeyboardInterrupt, StopIteration)):
            patch.setattr(type(services.store), "delete", _after(place, real))
            if not GarbageCollector(services).execute_deletions():
                raise StopIteration
        place += 1
    assert differences(services.index, services.store) == []
    assert keys(services, *folders) == set()


COLLECTED = pytest.mark.parametrize("collected", [False, True], ids=["at once", "after the controller"])


def collect_garbage(services: Services) -> None:
    while GarbageCollector(services).execute_deletions():
        pass
    GarbageCollector(services).execute_deletions()


def all_shown(services: Services) -> object:
    jobs, datasets = services.index.jobs, services.index.datasets
    told = [(job, jobs.attempts(job=job.id)) for job in jobs.page().items]
    told += [(one, datasets.snapshots(one.name).items) for one in datasets.page().items]
    return told, [(tag.name, tag.grasps) for tag in services.index.tags.all()]


@COLLECTED
@pytest.mark.parametrize("what", ["job", "dataset", "tag"])
def test_what_was_deleted_is_restored_as_it_was(services: Services, what: Any, collected: bool) -> None:
    MAKE[what](services)
    if what == "dataset":
        actions.take_snapshot(services, "d")
    fail(services, job_actions.submit(services, request(seed=7))[0].id)
    before = all_shown(services)
    DELETE[what](services)
    assert all_shown(services) != before
    if collected:
        collect_garbage(services)
    restore(services, what, restorable_deletions(services.store, what)[0].id, permit=lambda _: None)
    assert all_shown(services) == before
    assert not restorable_deletions(services.store)
    assert not GarbageCollector(services).execute_deletions()
    assert differences(services.index, services.store) == []


#: What gets the name of what was deleted.
ANOTHER: dict[Any, Act] = {
    "dataset": lambda services: dataset(services, grasps=64),
    "object": lambda services: add_asset(services, "object", "ball", content="other"),
    "tag": tag,
}


@pytest.mark.parametrize("what", ANOTHER)
def test_what_was_made_again_is_not_written_over(services: Services, what: Any) -> None:
    MAKE[what](services)
    DELETE[what](services)
    collect_garbage(services)
    ANOTHER[what](services)
    before = {key: services.store.get(key) for key in keys(services, "assets", "datasets", "tags")}
    with pytest.raises(ConflictError, match=r"there is .* '.*' (again|now); delete that first"):
        restore(services, what, restorable_deletions(services.store, what)[0].id, permit=lambda _: None)
    assert {key: services.store.get(key) for key in before} == before


#: What is there, what others do just before the lock of a request, the request, and what it is told.
MEANWHILE: list[tuple[Act, list[Act], Act, str]] = [
    (finished, [DELETE["job"]], DELETE["job"], "there is no job"),
    (
        finished,
        [DELETE["job"], collect_garbage],
        lambda services: job_actions.enter_job(services, record_of(services, _jobs(services)[0]), keeps_assets=True),
        "deleted just now; submit it again",
    ),
    (tag, [DELETE["tag"]], DELETE["tag"], "there is no tag"),
    (
        dataset,
        [DELETE["dataset"], collect_garbage, ANOTHER["dataset"]],
        lambda services: actions.take_snapshot(services, "d"),
        "there is another one; try again",
    ),
]


@pytest.mark.parametrize(("make", "rivals", "ask", "words"), MEANWHILE)
def test_what_changed_before_the_lock_is_told(
    services: Services, monkeypatch: pytest.MonkeyPatch, make: Act, rivals: list[Act], ask: Act, words: str
) -> None:
    def after_the_rivals(*given: Any) -> Any:
        monkeypatch.undo()
        for rival in rivals:
            rival(services)
        return Database.write_transaction(*given)

    make(services)
    monkeypatch.setattr(Database, "write_transaction", after_the_rivals)
    with pytest.raises((ConflictError, NotFoundError), match=words):
        ask(services)


@COLLECTED
def test_a_job_is_restored_after_its_object(services: Services, collected: bool) -> None:
    job, before = finished(services), services.index.assets.get(AssetKind.OBJECT, "ball")
    delete_job(services, job)
    delete_asset(services, AssetKind.OBJECT, "ball")
    if collected:
        collect_garbage(services)
    with pytest.raises(ConflictError, match="graspd objects restore"):
        restore(services, "job", job, permit=lambda _: None)
    collect_garbage(services)
    assert differences(services.index, services.store) == []
    restore(services, "object", "ball", permit=lambda _: None)
    restore(services, "job", job, permit=lambda _: None)
    assert services.index.assets.get(AssetKind.OBJECT, "ball") == before
    assert services.index.jobs.get(job).state is State.SUCCEEDED
    assert differences(services.index, services.store) == []


def _after(count: int, real: Any) -> Any:
    """A removal that works so often, and ends the process then."""
    left = [count]

    def delete(store: Any, key: str) -> None:
        if left[0] == 0:
            raise KeyboardInterrupt
        left[0] -= 1
        real(store, key)

    return delete


def test_a_refused_upload_is_deleted_after_an_hour(services: Services, monkeypatch: pytest.MonkeyPatch) -> None:
    bad, good = add_asset(services, "object", "bad", verdict="refuse"), add_asset(services, "object", "good")
    collector = GarbageCollector(services)
    collector.collect()
    assert services.index.assets.get(AssetKind.OBJECT, bad).verdict == "refuse", "a form may check it again"
    monkeypatch.setattr("graspd.service.pipeline.deletion.REFUSED_S", -1.0)
    collector.collect()
    assert keys(services, f"assets/object/{bad}", "removed", "deletions") == set()
    assert differences(services.index, services.store) == []
    assert services.index.assets.get(AssetKind.OBJECT, "good").digest == good
