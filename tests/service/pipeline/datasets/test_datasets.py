"""A dataset from its creation to its end: what it plans, repeats, cancels, retries; and that the store tells it all."""

from __future__ import annotations

import json

import pytest

from service.index.rebuild import differences, rebuild
from service.model import names
from service.model.domain import JobRequest
from service.model.errors import ConflictError, InputError, LimitError, NotFoundError
from service.model.states import AssetKind, Lane, State
from service.pipeline import job_actions
from service.pipeline.backends import Parts
from service.pipeline.datasets import actions
from service.pipeline.datasets.rounds import DatasetRounds
from service.pipeline.datasets.status import status
from service.store.records import job_events
from service.store.store import open_store
from tests.planning import plan_all
from tests.service.pipeline.datasets.makers import add_asset, fail, finish, jobs_of, wanted


def test_a_dataset_has_a_job_for_each_hand_and_object(either: Parts) -> None:
    dataset, new = actions.create(either, wanted(scenes=1))
    assert new and (dataset.cells, dataset.asked, dataset.state) == (4, 128, State.QUEUED)
    plan_all(either)
    pairs = [
        (either.index.jobs.get(job).request.hand, either.index.jobs.get(job).request.object)
        for job in jobs_of(either, "grasps")
    ]
    assert pairs == [("gripper", "ball"), ("gripper", "cube"), ("claw", "ball"), ("claw", "cube")]
    assert {either.index.jobs.get(job).lane for job in jobs_of(either, "grasps")} == {Lane.BULK}
    assert {either.index.jobs.get(job).request.scenes for job in jobs_of(either, "grasps")} == {1}


def test_the_same_dataset_again_is_the_same_and_repeats_nothing(parts: Parts) -> None:
    actions.create(parts, wanted())
    plan_all(parts)
    finish(parts, jobs_of(parts, "grasps")[0])
    queued = parts.queue.waiting()
    again, new = actions.create(parts, wanted())
    plan_all(parts)
    assert not new and again.states[State.SUCCEEDED] == 1
    assert parts.queue.waiting() == queued
    assert len(parts.index.jobs.page().items) == 4


def test_a_planner_that_was_stopped_is_continued(parts: Parts) -> None:
    actions.create(parts, wanted())
    ticks = iter(range(100))
    assert DatasetRounds(parts, clock=lambda: next(ticks)).advance(2.5)
    planned = [cell.planned for cell in parts.index.datasets.cells("grasps").items]
    assert planned.count(True) == 2
    plan_all(parts)
    assert all(cell.planned for cell in parts.index.datasets.cells("grasps").items)
    assert not DatasetRounds(parts).advance(10)


def test_two_datasets_share_the_jobs_that_both_want(parts: Parts) -> None:
    actions.create(parts, wanted("one"))
    actions.create(parts, wanted("two", hands=("gripper",), objects=("cube", "cone")))
    plan_all(parts)
    assert jobs_of(parts, "one")[1] == jobs_of(parts, "two")[0]
    assert len(parts.index.jobs.page().items) == 5


def test_a_job_that_was_submitted_by_itself_is_a_cell(parts: Parts) -> None:
    job, _ = job_actions.submit(parts, JobRequest(hand="claw", object="ball", grasps=32))
    actions.create(parts, wanted())
    assert jobs_of(parts, "grasps")[2] == job.id


def test_a_name_stands_for_one_dataset(parts: Parts) -> None:
    actions.create(parts, wanted())
    with pytest.raises(ConflictError, match="its objects are ball, cube; its grasps is 32\\); take another name"):
        actions.create(parts, wanted(objects=("ball",), grasps=64))


def test_a_dataset_of_an_older_graspd_with_fewer_options_is_the_same(parts: Parts) -> None:
    actions.create(parts, wanted())
    old = json.loads(parts.store.get(names.dataset_record("grasps")))
    del old["options"]["robustness"], old["checksum"]
    fresh = Parts(parts.settings, open_store("memory://"), parts.index, parts.queue)
    fresh.store.put(names.dataset_record("grasps"), json.dumps(old | {"digest": "0" * 32}).encode())
    dataset, new = actions.create(fresh, wanted())
    assert not new and dataset.digest == "0" * 32


def test_a_dataset_keeps_the_versions_it_was_created_with(parts: Parts) -> None:
    first = parts.index.assets.get(AssetKind.OBJECT, "ball").digest
    actions.create(parts, wanted())
    add_asset(parts, "object", "ball", content="other")
    plan_all(parts)
    assert parts.index.jobs.get(jobs_of(parts, "grasps")[0]).object_digest == first


def test_what_cannot_be_used_is_refused_before_anything_is_recorded(parts: Parts) -> None:
    add_asset(parts, "object", "torn", verdict="refuse")
    add_asset(parts, "object", "fresh", verdict=None)
    for changes, error, words in (
        ({"hands": ("foot",)}, NotFoundError, "there is no hand 'foot'; there are: claw, gripper"),
        ({"objects": ("torn",)}, InputError, "was refused"),
        ({"objects": ("fresh",)}, ConflictError, "still being checked"),
        ({"sets": ("kitchen",)}, NotFoundError, "there is no set of objects 'kitchen'"),
    ):
        with pytest.raises(error, match=words):
            actions.create(parts, wanted(**changes))
    with pytest.raises(ValueError, match="needs objects"):
        wanted(objects=())
    assert parts.index.datasets.page().items == [] and not list(parts.store.list(names.DATASETS))


def test_a_matrix_over_the_limit_is_refused(parts: Parts) -> None:
    with pytest.raises(LimitError, match="over 100000 cells"):
        actions.create(parts, wanted(hands=("gripper", "claw"), objects=[f"o{i}" for i in range(60_000)]))


def test_status_tells_each_cell(either: Parts) -> None:
    actions.create(either, wanted(grasps=64))
    plan_all(either)
    jobs = jobs_of(either, "grasps")
    finish(either, jobs[0])
    finish(either, jobs[1], batches=1)
    fail(either, jobs[2], "the mesh is torn")
    found = status(either.index, "grasps")
    assert [cell.state for cell in found.cells] == ["succeeded", "running", "failed", "queued"]
    assert [cell.grasps for cell in found.cells] == [64, 32, 0, 0]
    assert [cell.progress for cell in found.cells] == [1.0, 0.5, 0.0, 0.0]
    done, failed = found.cells[0], found.cells[2]
    assert done.valid_yield == done.valid / done.tried and found.cells[3].valid_yield is None
    assert (failed.tasks_failed, failed.attempts_failed, failed.reason) == (2, 2, "the mesh is torn")
    whole = found.dataset
    assert (whole.state, whole.grasps, whole.tasks, whole.tasks_done, whole.tasks_failed) == ("running", 96, 8, 3, 2)
    assert whole.progress == pytest.approx(3 / 8)
    assert whole.seconds == pytest.approx(1.5) and whole.shards == 3


def test_a_dataset_that_found_fewer_grasps_says_what_became_of_the_others(either: Parts) -> None:
    actions.create(either, wanted(objects=("ball",)))
    plan_all(either)
    first, second = jobs_of(either, "grasps")
    finish(either, first, lost={"slipped": 3})
    assert status(either.index, "grasps").dataset.reason is None
    finish(either, second, lost={"slipped": 1, "turned": 2})
    found = status(either.index, "grasps")
    whole = found.dataset
    assert whole.valid < 64 and whole.outcomes == {"turned": 2, "slipped": 4}
    assert whole.reason is not None and f"found {whole.valid} of 64 valid" in whole.reason
    reasons = [cell.reason or "" for cell in found.cells]
    assert "3 slipped;" in reasons[0] and "2 turned in the hand, 1 slipped;" in reasons[1]


def test_cells_come_in_pages_and_by_state(either: Parts) -> None:
    actions.create(either, wanted(objects=("ball", "cube", "cone")))
    plan_all(either)
    for job in jobs_of(either, "grasps")[1:4]:
        finish(either, job)
    first = either.index.datasets.cells("grasps", state=State.SUCCEEDED, limit=2)
    rest = either.index.datasets.cells("grasps", state=State.SUCCEEDED, limit=2, cursor=first.next)
    assert [cell.position for cell in first.items + rest.items] == [1, 2, 3] and rest.next is None


def test_datasets_come_newest_first_in_pages(parts: Parts) -> None:
    for name in ("a", "b", "c"):
        actions.create(parts, wanted(name))
    first = parts.index.datasets.page(limit=2)
    rest = parts.index.datasets.page(limit=2, cursor=first.next)
    assert sorted(view.name for view in first.items + rest.items) == ["a", "b", "c"] and rest.next is None


def test_cancel_stops_what_is_planned_and_what_is_not(parts: Parts) -> None:
    actions.create(parts, wanted())
    ticks = iter(range(100))
    DatasetRounds(parts, clock=lambda: next(ticks)).advance(2.5)
    finish(parts, jobs_of(parts, "grasps")[0])
    assert actions.cancel(parts, "grasps").cancelled
    plan_all(parts)
    found = status(parts.index, "grasps")
    assert [cell.state for cell in found.cells] == ["succeeded", "cancelled", "cancelled", "cancelled"]
    assert found.dataset.state == "cancelled" and parts.index.feed.believed_queued()[0] == set()
    with pytest.raises(ConflictError, match="nothing to cancel"):
        actions.cancel(parts, "grasps")


def test_a_job_that_another_dataset_waits_for_goes_on(either: Parts) -> None:
    actions.create(either, wanted("one"))
    actions.create(either, wanted("two", hands=("gripper",), objects=("cube",)))
    plan_all(either)
    actions.cancel(either, "one")
    plan_all(either)
    assert [cell.state for cell in status(either.index, "one").cells] == [
        "cancelled",
        "queued",
        "cancelled",
        "cancelled",
    ]


def test_retry_starts_failed_and_cancelled_cells_again_and_repeats_nothing(parts: Parts) -> None:
    actions.create(parts, wanted(grasps=64))
    plan_all(parts)
    jobs = jobs_of(parts, "grasps")
    finish(parts, jobs[0])
    finish(parts, jobs[1], batches=1)
    fail(parts, jobs[2])
    with pytest.raises(NotFoundError):
        actions.retry(parts, "other")
    actions.cancel(parts, "grasps")
    plan_all(parts)
    assert actions.retry(parts, "grasps").state is State.QUEUED
    plan_all(parts)
    found = status(parts.index, "grasps")
    assert [cell.state for cell in found.cells] == ["succeeded", "running", "queued", "queued"]
    assert len(parts.index.feed.believed_queued()[0]) == 1 + 2 + 2
    for job in jobs:
        finish(parts, job)
    assert parts.index.datasets.get("grasps").state == "succeeded" and parts.index.datasets.get("grasps").finished
    with pytest.raises(ConflictError, match="nothing to retry"):
        actions.retry(parts, "grasps")


def test_an_event_reaches_a_job_once_however_often_the_planner_runs(parts: Parts) -> None:
    actions.create(parts, wanted())
    plan_all(parts)
    actions.cancel(parts, "grasps")
    plan_all(parts)
    started = jobs_of(parts, "grasps")[0]
    job_actions.retry(parts, started)
    rebuild(parts.index, parts.store)  # forgets how far the planner was
    plan_all(parts)
    assert parts.index.jobs.get(started).state == "queued"
    assert [event.what for event in job_events(parts.store, started)] == ["cancelled", "retried"]
    assert [event.what for event in job_events(parts.store, jobs_of(parts, "grasps")[1])] == ["cancelled"]


def test_a_large_dataset_leaves_the_queue_to_others(parts: Parts) -> None:
    small = parts.settings.model_copy(update={"queue_window": 10})
    parts = Parts(small, parts.store, parts.index, parts.queue)
    actions.create(parts, wanted(grasps=320))
    plan_all(parts)
    assert len(parts.queue.waiting()) == 10
    assert parts.queue.depths()[(Lane.INTERACTIVE, "synthesize")] == 0
    assert parts.index.datasets.get("grasps").tasks == 40


def test_the_store_alone_tells_everything(either: Parts) -> None:
    actions.add_object_set(either, "round", ["ball", "cone"])
    actions.create(either, wanted("a"))
    actions.create(either, wanted("b", objects=(), sets=("round",)))
    plan_all(either)
    for job in jobs_of(either, "a"):
        finish(either, job)
    actions.snapshot(either, "a")
    actions.cancel(either, "b")
    plan_all(either)
    assert differences(either.index, either.store) == []
    before = [either.index.datasets.get(name) for name in ("a", "b")]
    counts = rebuild(either.index, either.store)
    assert (counts["datasets"], counts["snapshots"], counts["object_sets"]) == (2, 1, 1)
    assert [either.index.datasets.get(name) for name in ("a", "b")] == before
    assert [view.shards for view in either.index.datasets.snapshots("a").items] == [4]


def test_a_difference_between_index_and_store_is_found(parts: Parts) -> None:
    actions.create(parts, wanted())
    parts.index.write_dataset.set_events("grasps", [])
    actions.add_dataset_event(parts.store, "grasps", "cancelled")
    assert differences(parts.index, parts.store) == [
        "datasets grasps: cancelled is False, the store says True",
        "datasets grasps: events is 0, the store says 1",
    ]


def test_a_set_of_objects_is_spelled_out_when_the_dataset_is_created(parts: Parts) -> None:
    actions.add_object_set(parts, "round", ["cone", "ball"])
    actions.create(parts, wanted(objects=("cube",), sets=("round",)))
    actions.add_object_set(parts, "round", ["ball"])
    assert parts.index.datasets.get("grasps").objects == ["cube", "ball", "cone"]


def test_a_set_has_versions_and_the_newest_counts(either: Parts) -> None:
    for objects in (["ball", "cone"], ["ball"], ["ball"], ["cone", "ball"]):
        assert set(actions.add_object_set(either, "round", objects).objects) == set(objects)
    assert len(list(either.store.list(names.OBJECT_SETS))) == 3
    assert [view.objects for view in either.index.object_sets.newest()] == [["ball", "cone"]]
    with pytest.raises(NotFoundError, match="there is no object 'moon'"):
        actions.add_object_set(either, "round", ["moon"])
    with pytest.raises(InputError, match="holds no object"):
        actions.add_object_set(either, "none", [])


def test_the_same_shards_are_the_same_snapshot(parts: Parts) -> None:
    actions.create(parts, wanted())
    with pytest.raises(ConflictError, match="no shard yet"):
        actions.snapshot(parts, "grasps")
    plan_all(parts)
    jobs = jobs_of(parts, "grasps")
    finish(parts, jobs[0])
    first, new = actions.snapshot(parts, "grasps")
    assert new and not first.complete and first.grasps == 32
    assert actions.snapshot(parts, "grasps") == (first, False)
    for job in jobs[1:]:
        finish(parts, job)
    last, new = actions.snapshot(parts, "grasps")
    assert new and last.complete and last.digest != first.digest
    assert [(shard.hand, shard.object) for shard in last.shards][1:3] == [("gripper", "cube"), ("claw", "ball")]
    assert last.size_bytes == sum(parts.store.size(shard.key) for shard in last.shards)
    assert actions.load_snapshot(parts.store, "grasps", first.digest) == first
