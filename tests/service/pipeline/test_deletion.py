"""What a user deletes is gone at once, from the index and from one made anew; its objects go with the controller."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from service.index.changes.removals import Removals
from service.index.rebuild import differences
from service.model import names
from service.model.errors import ConflictError, NotFoundError
from service.model.states import AssetKind, State
from service.model.tags import tag_id
from service.pipeline import job_actions, tagging
from service.pipeline.backends import Parts
from service.pipeline.datasets import actions
from service.pipeline.datasets.spec import DatasetRequest
from service.pipeline.deletion import delete_asset, delete_dataset, delete_job, restore
from service.pipeline.garbage_collector import GarbageCollector
from service.store.deletions import deletions, pending
from service.store.library import publish_asset
from tests.fakes import OBJECT_FILES, make_shard, request
from tests.planning import plan_all
from tests.service.pipeline.datasets.makers import fail


def finished(parts: Parts, **changes: Any) -> str:
    """A job whose shards are there."""
    job, _ = job_actions.submit(parts, request(**changes))
    _make_all(parts)
    assert parts.index.jobs.get(job.id).state is State.SUCCEEDED
    return job.id


def _make_all(parts: Parts) -> None:
    queue: Any = parts.queue
    while (delivery := queue.take("w")) is not None:
        parts.index.write.add_manifest(make_shard(parts.store, delivery.message))
        queue.finish(delivery)
        for job in parts.index.jobs.page().items:
            job_actions._start(parts, job.id)


def dataset(parts: Parts, name: str = "d", **changes: Any) -> str:
    """A finished dataset of one cell."""
    wanted = DatasetRequest(name=name, hands=("gripper",), objects=("ball",), **{"grasps": 32, **changes})
    actions.create(parts, wanted)
    plan_all(parts)
    _make_all(parts)
    assert parts.index.datasets.get(name).state is State.SUCCEEDED
    return name


def keys(parts: Parts, *prefixes: str) -> set[str]:
    return {entry.key for prefix in prefixes for entry in parts.store.list(prefix)}


def graceless(parts: Parts) -> GarbageCollector:
    """A garbage collector to which every released shard is old."""
    eager = parts.settings.model_copy(update={"shard_grace_s": -1.0})
    return GarbageCollector(Parts(eager, parts.store, parts.index, parts.queue))


def test_a_deleted_job_is_gone_at_once_and_its_objects_with_the_controller(parts: Parts) -> None:
    job = finished(parts)
    delete_job(parts, job)
    with pytest.raises(NotFoundError):
        parts.index.jobs.get(job)
    assert differences(parts.index, parts.store) == [], "an index made anew knows it as little"
    assert not GarbageCollector(parts).advance()
    assert keys(parts, "jobs", "tasks", "deletions") == set()
    assert differences(parts.index, parts.store) == []


def test_shards_that_nobody_needs_go_after_the_grace_time(parts: Parts) -> None:
    job = finished(parts)
    delete_job(parts, job)
    GarbageCollector(parts).advance()
    assert not GarbageCollector(parts).collect()
    assert len(keys(parts, "shards")) == 2, "there is grace"
    assert not graceless(parts).collect(budget_s=60)
    assert keys(parts, "shards", "released") == set()
    assert parts.index.overview.stats().grasps == 0
    assert differences(parts.index, parts.store) == []


def test_a_shard_that_another_job_needs_stays(parts: Parts) -> None:
    short, long = finished(parts), finished(parts, grasps=64)
    delete_job(parts, short)
    GarbageCollector(parts).advance()
    assert not graceless(parts).collect(budget_s=60)
    assert len(keys(parts, "shards")) == 4
    assert parts.index.jobs.get(long).grasps == 64


def test_a_deleted_job_may_be_submitted_again_and_finds_its_shards(parts: Parts) -> None:
    job = finished(parts)
    delete_job(parts, job)
    with pytest.raises(ConflictError, match="still being removed"):
        job_actions.submit(parts, request())
    assert names.job_record(job) in keys(parts, "jobs")
    GarbageCollector(parts).advance()
    again, new = job_actions.submit(parts, request())
    assert (again.id, new, again.state) == (job, True, State.SUCCEEDED)
    assert not graceless(parts).collect(budget_s=60)
    assert len(keys(parts, "shards")) == 2, "it needs them again"
    assert differences(parts.index, parts.store) == []


def test_a_job_that_runs_is_in_use(parts: Parts) -> None:
    job, _ = job_actions.submit(parts, request())
    with pytest.raises(ConflictError, match="is queued; cancel it first"):
        delete_job(parts, job.id)
    assert not pending(parts.store)


def test_a_job_of_a_dataset_is_in_use(parts: Parts) -> None:
    dataset(parts)
    (job,) = parts.index.jobs.page().items
    with pytest.raises(ConflictError, match="belongs to dataset 'd'"):
        delete_job(parts, job.id)


def test_a_deleted_dataset_takes_its_own_jobs_with_it(parts: Parts) -> None:
    own = finished(parts, seed=7)
    dataset(parts)
    dataset(parts, "other", grasps=64)
    actions.snapshot(parts, "d")
    delete_dataset(parts, "d", with_snapshots=True)
    assert differences(parts.index, parts.store) == []
    with pytest.raises(ConflictError, match="still being removed"):
        dataset(parts)
    while GarbageCollector(parts).advance():
        pass
    GarbageCollector(parts).advance()
    assert {view.name for view in parts.index.datasets.page().items} == {"other"}
    assert len(parts.index.jobs.page().items) == 2
    assert parts.index.jobs.get(own)
    assert keys(parts, "datasets") == {names.dataset_record("other")}
    assert differences(parts.index, parts.store) == []
    dataset(parts, "d", grasps=96)


def test_a_dataset_that_runs_is_in_use(parts: Parts) -> None:
    actions.create(parts, DatasetRequest(name="d", hands=("gripper",), objects=("ball",)))
    with pytest.raises(ConflictError, match="cancel it first"):
        delete_dataset(parts, "d")


def test_a_dataset_that_was_just_cancelled_can_be_deleted(parts: Parts) -> None:
    """Before the planner has told its jobs; those end with it."""
    actions.create(parts, DatasetRequest(name="d", hands=("gripper",), objects=("ball",)))
    plan_all(parts)
    assert actions.cancel(parts, "d").state is State.CANCELLED
    delete_dataset(parts, "d")
    GarbageCollector(parts).advance()
    assert not parts.index.jobs.page().items


def test_a_cancelled_dataset_has_ended_though_another_waits_for_its_jobs(parts: Parts) -> None:
    for name in ("d", "other"):
        actions.create(parts, DatasetRequest(name=name, hands=("gripper",), objects=("ball",)))
    plan_all(parts)
    assert actions.cancel(parts, "d").state is State.CANCELLED
    plan_all(parts)
    delete_dataset(parts, "d")
    while GarbageCollector(parts).advance():
        pass
    (job,) = parts.index.jobs.page().items
    assert job.state is State.QUEUED, "the other dataset waits for it"


def test_a_hand_that_a_job_needs_is_in_use(parts: Parts) -> None:
    job = finished(parts)
    with pytest.raises(ConflictError, match=f"needed by job {job}"):
        delete_asset(parts, AssetKind.HAND, "gripper")
    delete_job(parts, job)
    delete_asset(parts, AssetKind.HAND, "gripper")
    with pytest.raises(NotFoundError):
        job_actions.submit(parts, request())


def test_an_object_of_a_set_is_in_use(parts: Parts) -> None:
    actions.add_object_set(parts, "kitchen", ["ball"])
    with pytest.raises(ConflictError, match="the set of objects 'kitchen'"):
        delete_asset(parts, AssetKind.OBJECT, "ball")


def test_a_deleted_object_frees_its_name_and_its_files(parts: Parts) -> None:
    digest = parts.index.assets.get(AssetKind.OBJECT, "ball").digest
    delete_asset(parts, AssetKind.OBJECT, "ball")
    assert differences(parts.index, parts.store) == []
    with pytest.raises(ConflictError, match="still being removed"):
        publish_asset(parts.store, AssetKind.OBJECT, "ball", OBJECT_FILES)
    GarbageCollector(parts).advance()
    assert keys(parts, f"assets/object/{digest}", "deletions") == set()
    assert publish_asset(parts.store, AssetKind.OBJECT, "orb", OBJECT_FILES).name == "orb"


def test_a_job_entered_while_its_hand_is_deleted_is_not_kept(parts: Parts) -> None:
    record = job_actions.prepare(parts, request())
    delete_asset(parts, AssetKind.HAND, "gripper")
    with pytest.raises(NotFoundError, match="deleted just now"):
        job_actions.enter(parts, record)
    assert keys(parts, "jobs") == set()


@pytest.mark.parametrize("what", ["job", "dataset", "object"])
def test_a_deletion_that_broke_off_is_carried_out_by_the_next_controller(
    parts: Parts, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At each removal of an object in turn, and between the record and the rows."""
    acts: dict[str, tuple[Callable[[], Any], Callable[[], Any]]] = {
        "job": (lambda: finished(parts, seed=3), lambda: delete_job(parts, next(iter(_jobs(parts))))),
        "dataset": (lambda: dataset(parts), lambda: delete_dataset(parts, "d")),
        "object": (lambda: None, lambda: delete_asset(parts, AssetKind.OBJECT, "ball")),
    }
    make, act = acts[what]
    make()
    remove = {"job": "remove_job", "dataset": "remove_dataset", "object": "remove_asset"}[what]
    with monkeypatch.context() as patch:
        patch.setattr(Removals, remove, _break)
        with pytest.raises(KeyboardInterrupt):
            act()
    assert pending(parts.store)
    real, place = type(parts.store).delete, 0
    while keys(parts, "deletions"):
        with monkeypatch.context() as patch, pytest.raises((KeyboardInterrupt, StopIteration)):
            patch.setattr(type(parts.store), "delete", _after(place, real))
            if not GarbageCollector(parts).advance():
                raise StopIteration
        place += 1
    assert differences(parts.index, parts.store) == []
    assert (
        keys(parts, *{"job": ("jobs",), "dataset": ("datasets", "jobs"), "object": ("assets/object",)}[what]) == set()
    )


def test_a_dataset_with_a_snapshot_is_deleted_only_by_a_further_word(parts: Parts) -> None:
    dataset(parts)
    actions.snapshot(parts, "d")
    with pytest.raises(ConflictError, match=r"has 1 snapshot.*--with-snapshots"):
        delete_dataset(parts, "d")
    assert parts.index.datasets.get("d").name == "d"
    assert not pending(parts.store)


COLLECTED = pytest.mark.parametrize("collected", [False, True], ids=["at once", "after the controller"])


def collect_garbage(parts: Parts) -> None:
    while GarbageCollector(parts).advance():
        pass
    GarbageCollector(parts).advance()


@COLLECTED
def test_a_deleted_job_is_restored_as_it_was(parts: Parts, collected: bool) -> None:
    """One that had failed, with its attempts: it is not run again."""
    job, _ = job_actions.submit(parts, request())
    fail(parts, job.id)
    before = parts.index.jobs.get(job.id), parts.index.jobs.attempts(job=job.id)
    delete_job(parts, job.id)
    if collected:
        collect_garbage(parts)
    restore(parts, "job", job.id, permit=lambda _: None)
    assert (parts.index.jobs.get(job.id), parts.index.jobs.attempts(job=job.id)) == before
    assert not deletions(parts.store)
    assert not GarbageCollector(parts).advance()
    assert differences(parts.index, parts.store) == []


@COLLECTED
def test_a_deleted_dataset_is_restored_with_its_jobs_and_snapshots(parts: Parts, collected: bool) -> None:
    dataset(parts)
    actions.snapshot(parts, "d")
    before = parts.index.datasets.get("d"), parts.index.datasets.snapshots("d").items, _jobs(parts)
    delete_dataset(parts, "d", with_snapshots=True)
    if collected:
        collect_garbage(parts)
        assert _jobs(parts) == []
    restore(parts, "dataset", "d", permit=lambda _: None)
    collect_garbage(parts)
    assert (parts.index.datasets.get("d"), parts.index.datasets.snapshots("d").items, _jobs(parts)) == before
    assert not deletions(parts.store)
    assert differences(parts.index, parts.store) == []


@COLLECTED
def test_a_deleted_object_is_restored_under_its_name(parts: Parts, collected: bool) -> None:
    before = parts.index.assets.get(AssetKind.OBJECT, "ball")
    delete_asset(parts, AssetKind.OBJECT, "ball")
    if collected:
        collect_garbage(parts)
    restore(parts, "object", "ball", permit=lambda _: None)
    assert parts.index.assets.get(AssetKind.OBJECT, "ball") == before
    assert differences(parts.index, parts.store) == []


def test_what_was_made_again_is_not_written_over(parts: Parts) -> None:
    dataset(parts)
    delete_dataset(parts, "d")
    collect_garbage(parts)
    dataset(parts, "d", grasps=64)
    with pytest.raises(ConflictError, match="there is a dataset 'd' again"):
        restore(parts, "dataset", "d", permit=lambda _: None)
    assert parts.index.datasets.get("d").asked == 64


def test_a_job_is_not_restored_without_its_object(parts: Parts) -> None:
    job = finished(parts)
    delete_job(parts, job)
    delete_asset(parts, AssetKind.OBJECT, "ball")
    collect_garbage(parts)
    with pytest.raises(ConflictError, match="graspd objects restore first"):
        restore(parts, "job", job, permit=lambda _: None)
    collect_garbage(parts)
    assert differences(parts.index, parts.store) == []
    restore(parts, "object", "ball", permit=lambda _: None)
    restore(parts, "job", job, permit=lambda _: None)
    assert parts.index.jobs.get(job).state is State.SUCCEEDED


def test_a_deleted_tag_is_restored_with_its_grasps(parts: Parts) -> None:
    job = finished(parts)
    shard = next(shard.id for shard in parts.index.shards.page(job=job).items if shard.kind == "base")
    tagging.give(parts, "good", [(shard, 0), (shard, 3)], project="", owner="", permit=lambda _: None)
    tagging.remove(parts, tag_id("good", ""), permit=lambda _: None)
    restore(parts, "tag", "good", permit=lambda _: None)
    assert [(tag.name, tag.grasps) for tag in parts.index.tags.all()] == [("good", 2)]
    assert not deletions(parts.store)


def test_after_the_grace_time_nothing_comes_back(parts: Parts) -> None:
    job = finished(parts)
    delete_job(parts, job)
    collect_garbage(parts)
    assert not graceless(parts).collect(budget_s=60)
    assert keys(parts, "removed") == set()
    with pytest.raises(NotFoundError, match="was deleted in the last 7 days"):
        restore(parts, "job", job, permit=lambda _: None)


def _jobs(parts: Parts) -> list[str]:
    return [job.id for job in parts.index.jobs.page().items]


def _break(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def _after(count: int, real: Any) -> Any:
    """A removal that works so often, and ends the process then."""
    left = [count]

    def delete(store: Any, key: str) -> None:
        if left[0] == 0:
            raise KeyboardInterrupt
        left[0] -= 1
        real(store, key)

    return delete
