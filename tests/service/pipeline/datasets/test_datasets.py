"""A dataset from its creation to its end and its export; its options; and that the store tells it all."""

import hashlib
import json
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import h5py
import pytest

from graspd.service.index.rebuild import differences, rebuild
from graspd.service.model import digests, errors, names
from graspd.service.model.domain import JobRequest
from graspd.service.model.planning import OUTCOMES
from graspd.service.model.projects import ProjectScope
from graspd.service.model.records import DatasetRecord, Snapshot, SnapshotShard, create_job_request, create_object_set
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.states import AssetKind, Priority, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.actions import DatasetController
from graspd.service.pipeline.datasets.cost import estimate
from graspd.service.pipeline.datasets.export import Fetch, export_shards, path_of
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.fidelity_choice import FidelityResolver
from graspd.service.store import records
from graspd.service.store.store import open_store
from tests.fakes import finish, plan_all, record_of
from tests.service.pipeline.datasets.makers import add_asset, cells_of, done, fail, jobs_of, wanted
from tests.service.pipeline.test_fidelity_choice import lifts, run


def test_a_dataset_has_a_job_for_each_hand_and_object(either: Services) -> None:
    dataset, new = actions.create(either, wanted(scenes=1))
    assert new and (dataset.cells, dataset.asked, dataset.state) == (4, 128, State.QUEUED)
    plan_all(either)
    jobs = [either.index.jobs.get(job) for job in jobs_of(either, "grasps")]
    pairs = [(job.request.hand, job.request.object) for job in jobs]
    assert pairs == [("gripper", "ball"), ("gripper", "cube"), ("claw", "ball"), ("claw", "cube")]
    assert {(job.priority, job.request.scenes) for job in jobs} == {(Priority.BULK, 1)}


def test_the_same_dataset_repeats_nothing_and_another_needs_another_name(services: Services) -> None:
    actions.create(services, wanted())
    plan_all(services)
    finish(services, jobs_of(services, "grasps")[0])
    queued = services.queue.waiting_tasks()
    again, new = actions.create(services, wanted())
    plan_all(services)
    assert not new and again.states[State.SUCCEEDED] == 1
    assert services.queue.waiting_tasks() == queued
    assert len(services.index.jobs.page().items) == 4
    with pytest.raises(errors.ConflictError, match=r"objects are ball, cube; its grasps is 32\); take another name"):
        actions.create(services, wanted(objects=("ball",), grasps=64))


def test_a_planner_that_was_stopped_is_continued(services: Services) -> None:
    actions.create(services, wanted())
    ticks = iter(range(100))
    assert DatasetController(services, clock=lambda: next(ticks)).advance(2.5)
    assert [cell.planned for cell in services.index.datasets.cells("grasps").items].count(True) == 2
    plan_all(services)
    assert all(cell.planned for cell in services.index.datasets.cells("grasps").items)
    assert not DatasetController(services).advance(10)


def test_records_of_an_older_graspd_are_read_and_are_the_same_dataset(services: Services) -> None:
    actions.create(services, wanted())
    old = json.loads(services.store.get(names.dataset_record_key("grasps")))
    del old["checksum"]
    old["options"]["robustness"] = 0
    fresh = Services(services.settings, open_store("memory://"), services.index, services.queue)
    fresh.store.put(names.dataset_record_key("grasps"), json.dumps(old | {"digest": "0" * 32}).encode())
    dataset, new = actions.create(fresh, wanted())
    assert not new and dataset.digest == "0" * 32
    stored = json.loads(services.store.get(names.dataset_record_key("grasps")))
    stored["options"] = {k: v for k, v in stored["options"].items() if k not in ("options", "target")}
    del stored["fidelities"]
    assert DatasetRecord.model_validate(stored) == records.load_dataset(services.store, "grasps")


def test_a_dataset_keeps_the_versions_it_was_created_with(services: Services) -> None:
    first = services.index.assets.get(AssetKind.OBJECT, "ball").digest
    actions.create(services, wanted())
    add_asset(services, "object", "ball", content="other")
    plan_all(services)
    assert services.index.jobs.get(jobs_of(services, "grasps")[0]).object_digest == first


def test_what_cannot_be_used_is_refused_before_it_is_recorded(services: Services) -> None:
    add_asset(services, "object", "torn", verdict="refuse")
    add_asset(services, "object", "fresh", verdict=None)
    for changes, error, words in (
        ({"hands": ("foot",)}, errors.NotFoundError, "there is no hand 'foot'; there are: claw, gripper"),
        ({"objects": ("torn",)}, errors.InputError, "was refused"),
        ({"objects": ("fresh",)}, errors.ConflictError, "still being checked"),
        ({"sets": ("kitchen",)}, errors.NotFoundError, "there is no set of objects 'kitchen'"),
    ):
        with pytest.raises(error, match=words):
            actions.create(services, wanted(**changes))
    with pytest.raises(ValueError, match="needs objects"):
        wanted(objects=())
    assert services.index.datasets.page().items == [] and not list(services.store.list(names.DATASETS))


def test_a_matrix_over_the_limit_is_refused(services: Services) -> None:
    for refuse in (actions.create, lambda of, asked: estimate(of.index, asked)):
        with pytest.raises(errors.LimitError, match="over 100000 cells"):
            refuse(services, wanted(hands=("gripper", "claw"), objects=[f"o{i}" for i in range(60_000)]))


def test_status_tells_each_cell(either: Services) -> None:
    actions.create(either, wanted(grasps=64))
    plan_all(either)
    jobs = jobs_of(either, "grasps")
    finish(either, jobs[0])
    finish(either, jobs[1], batches=1)
    fail(either, jobs[2], "the mesh is torn")
    cells = cells_of(either)
    told = [(cell.state, cell.grasps, cell.progress) for cell in cells]
    assert told == [("succeeded", 64, 1.0), ("running", 32, 0.5), ("failed", 0, 0.0), ("queued", 0, 0.0)]
    done, failed = cells[0], cells[2]
    assert done.valid_yield == done.valid / done.candidates and cells[3].valid_yield is None
    assert (failed.tasks_failed, failed.attempts_failed, failed.reason) == (2, 2, "the mesh is torn")
    whole = either.index.datasets.get("grasps")
    assert (whole.state, whole.grasps, whole.tasks, whole.tasks_done, whole.tasks_failed) == ("running", 96, 8, 3, 2)
    assert whole.progress == pytest.approx(3 / 8) and whole.seconds == pytest.approx(1.5) and whole.shards == 3


def test_a_dataset_that_found_fewer_grasps_tells_the_outcomes(either: Services) -> None:
    actions.create(either, wanted(objects=("ball",)))
    plan_all(either)
    first, second = jobs_of(either, "grasps")
    finish(either, first, outcomes={"slipped": 3})
    assert either.index.datasets.get("grasps").reason is None
    finish(either, second, outcomes={"slipped": 1, "turned": 2})
    whole = either.index.datasets.get("grasps")
    assert whole.valid < 64 and whole.outcomes == {"turned": 2, "slipped": 4}
    assert whole.reason is not None and f"found {whole.valid} of 64 valid" in whole.reason
    reasons = [cell.reason or "" for cell in cells_of(either)]
    assert "3 slipped;" in reasons[0] and f"2 {OUTCOMES['turned']}, 1 slipped;" in reasons[1]


def test_cancel_stops_what_is_planned_and_what_is_not(services: Services) -> None:
    actions.create(services, wanted())
    ticks = iter(range(100))
    DatasetController(services, clock=lambda: next(ticks)).advance(2.5)
    finish(services, jobs_of(services, "grasps")[0])
    assert actions.cancel(services, "grasps").cancelled
    plan_all(services)
    assert [cell.state for cell in cells_of(services)] == ["succeeded", "cancelled", "cancelled", "cancelled"]
    assert services.index.datasets.get("grasps").state == "cancelled"
    assert services.index.feed.queued_tasks_and_checks()[0] == set()
    with pytest.raises(errors.ConflictError, match="nothing to cancel"):
        actions.cancel(services, "grasps")


def test_a_job_that_another_dataset_waits_for_goes_on(either: Services) -> None:
    actions.create(either, wanted("one"))
    actions.create(either, wanted("two", hands=("gripper",), objects=("cube",)))
    plan_all(either)
    actions.cancel(either, "one")
    plan_all(either)
    assert [cell.state for cell in cells_of(either, "one")] == ["cancelled", "queued", "cancelled", "cancelled"]


def test_retry_starts_failed_and_cancelled_cells_again(services: Services) -> None:
    actions.create(services, wanted(grasps=64))
    plan_all(services)
    jobs = jobs_of(services, "grasps")
    finish(services, jobs[0])
    finish(services, jobs[1], batches=1)
    fail(services, jobs[2])
    with pytest.raises(errors.NotFoundError):
        actions.retry(services, "other")
    actions.cancel(services, "grasps")
    plan_all(services)
    assert actions.retry(services, "grasps").state is State.QUEUED
    plan_all(services)
    assert [cell.state for cell in cells_of(services)] == ["succeeded", "running", "queued", "queued"]
    assert len(services.index.feed.queued_tasks_and_checks()[0]) == 1 + 2 + 2
    for job in jobs:
        finish(services, job)
    assert services.index.datasets.get("grasps").state == "succeeded" and services.index.datasets.get("grasps").finished
    with pytest.raises(errors.ConflictError, match="nothing to retry"):
        actions.retry(services, "grasps")


def test_an_event_reaches_a_job_once(services: Services) -> None:
    actions.create(services, wanted())
    plan_all(services)
    actions.cancel(services, "grasps")
    plan_all(services)
    started = jobs_of(services, "grasps")[0]
    job_actions.retry(services, started)
    rebuild(services.index, services.store)  # forgets how far the planner was
    plan_all(services)
    assert services.index.jobs.get(started).state == "queued"
    assert [event.what for event in records.job_events(services.store, started)] == ["cancelled", "retried"]
    assert [event.what for event in records.job_events(services.store, jobs_of(services, "grasps")[1])] == ["cancelled"]


def test_the_store_alone_tells_everything(either: Services) -> None:
    actions.add_object_set(either, "round", ["ball", "cone"])
    done(either, "a")
    actions.create(either, wanted("b", objects=(), sets=("round",)))
    plan_all(either)
    actions.take_snapshot(either, "a")
    actions.cancel(either, "b")
    plan_all(either)
    assert differences(either.index, either.store) == []
    before = [either.index.datasets.get(name) for name in ("a", "b")]
    counts = rebuild(either.index, either.store)
    assert (counts["datasets"], counts["snapshots"], counts["object_sets"]) == (2, 1, 1)
    assert [either.index.datasets.get(name) for name in ("a", "b")] == before
    assert [view.shards for view in either.index.datasets.snapshots("a").items] == [4]


def test_a_set_has_versions_and_the_newest_counts(either: Services) -> None:
    for objects in (["ball", "cone"], ["ball"], ["ball"], ["cone", "ball"]):
        assert set(actions.add_object_set(either, "round", objects).objects) == set(objects)
    assert len(list(either.store.list(names.OBJECT_SETS))) == 3
    assert [view.objects for view in either.index.object_sets.newest_versions()] == [["ball", "cone"]]
    with pytest.raises(errors.NotFoundError, match="there is no object 'moon'"):
        actions.add_object_set(either, "round", ["moon"])
    with pytest.raises(errors.InputError, match="holds no object"):
        actions.add_object_set(either, "none", [])


def test_a_set_that_broke_off_keeps_its_name_in_its_project(services: Services) -> None:
    left = create_object_set("round", ["ball"], project="blue")
    records.put_record(services.store, names.object_set_key("round", left.digest), left)
    with pytest.raises(errors.ConflictError, match="take another name"):
        actions.add_object_set(services, "round", ["ball"], scope=ProjectScope("", everything=False))


def test_the_same_shards_are_the_same_snapshot(services: Services) -> None:
    actions.create(services, wanted())
    with pytest.raises(errors.ConflictError, match="no shard yet"):
        actions.take_snapshot(services, "grasps")
    plan_all(services)
    jobs = jobs_of(services, "grasps")
    finish(services, jobs[0])
    first, new = actions.take_snapshot(services, "grasps")
    assert new and not first.complete and first.grasps == 32
    assert actions.take_snapshot(services, "grasps") == (first, False)
    for job in jobs[1:]:
        finish(services, job)
    last, new = actions.take_snapshot(services, "grasps")
    assert new and last.complete and last.digest != first.digest
    assert [(shard.hand, shard.object) for shard in last.shards][1:3] == [("gripper", "cube"), ("claw", "ball")]
    assert last.size_bytes == sum(services.store.size(shard.key) for shard in last.shards)
    assert records.load_snapshot(services.store, "grasps", first.digest) == first


@pytest.fixture
def snapshot(services: Services) -> Snapshot:
    done(services, scenes=1)
    return actions.take_snapshot(services, "grasps")[0]


@pytest.fixture
def source(services: Services) -> Fetch:
    return lambda shard: services.store.stream(shard.key)


def test_every_file_is_there_with_its_checksum(source: Fetch, snapshot: Snapshot, tmp_path: Path) -> None:
    assert export_shards(snapshot, tmp_path / "out", source) == 8
    check = subprocess.run(["sha256sum", "-c", "--quiet", "checksums.sha256"], cwd=tmp_path / "out", check=False)
    assert check.returncode == 0
    assert Snapshot.model_validate_json((tmp_path / "out" / "snapshot.json").read_text()) == snapshot
    with h5py.File(tmp_path / "out" / "claw" / "cube" / "base-00000.h5") as file:
        assert file.attrs["hand"] == "claw" and len(file["grasp/hand_pose"]) == 32


def test_an_export_that_broke_off_is_gone_on_with(source: Fetch, snapshot: Snapshot, tmp_path: Path) -> None:
    def breaks_off(shard: SnapshotShard) -> Iterable[bytes]:
        if shard == snapshot.shards[5]:
            raise errors.StoreUnavailable("away")
        return source(shard)

    with pytest.raises(errors.StoreUnavailable):
        export_shards(snapshot, tmp_path / "out", breaks_off)
    assert not (tmp_path / "out" / "snapshot.json").exists() and not list(tmp_path.rglob("*.part"))
    assert export_shards(snapshot, tmp_path / "out", source) == 3


def test_a_file_that_was_changed_is_fetched_again(source: Fetch, snapshot: Snapshot, tmp_path: Path) -> None:
    export_shards(snapshot, tmp_path, source)
    spoilt = tmp_path / path_of(snapshot.shards[0])
    spoilt.write_bytes(b"x" * snapshot.shards[0].size_bytes)
    assert export_shards(snapshot, tmp_path, source) == 1
    assert hashlib.sha256(spoilt.read_bytes()).hexdigest() == snapshot.shards[0].sha256


def test_a_wrong_checksum_leaves_no_file_and_a_folder_must_be_possible(
    snapshot: Snapshot, tmp_path: Path, source: Fetch
) -> None:
    with pytest.raises(errors.DamagedShard, match=snapshot.shards[0].id):
        export_shards(snapshot, tmp_path / "out", lambda shard: [b"something else"])
    assert [path for path in (tmp_path / "out").rglob("*") if path.is_file()] == []
    (tmp_path / "file").write_text("")
    with pytest.raises(errors.InputError, match="cannot be made"):
        export_shards(snapshot, tmp_path / "file" / "out", source)


ANNEALED = {"method": "graspit", "options": {"keep": 20, "steps": 40000}}
AUTO = {"fidelity": "auto", "target": "gsr>=0.6"}
_ON_BALL = (("draft", 40, 0.3), ("standard", 15, 0.8))


def chart(created: str = "2026-11-21T10:00:00.000Z", *, claw: str = "fine") -> dict[str, Any]:
    runs = [run(name, speed, gsr, hand="gripper", object_="ball") for name, speed, gsr in _ON_BALL]
    runs.append(run("draft", 40, 0.9, hand="gripper", object_="cube"))
    runs.append(run(claw, 6, 0.7, hand="claw", object_="elsewhere"))
    return {"created": created, "runs": runs}


#: Of each cell, by that chart.
CHOSEN = ["standard", "draft", "fine", "fine"]


def requests_of(services: Services, name: str = "grasps") -> list[JobRequest]:
    plan_all(services)
    return [record_of(services, job).request for job in jobs_of(services, name)]


def test_a_cell_without_options_is_the_job_it_always_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """The id was computed by graspd 0.1.0 before datasets had options."""
    monkeypatch.setattr(digests, "STAGE_REVISIONS", {"synthesize": 1})
    given = {"name": "x", "hands": ["allegro"], "objects": ["mug"], "grasps": 64, "scenes": 2}
    request = create_job_request(DatasetRequest.model_validate(given).cell_options, "allegro", "mug")
    assert digests.job_id(request, "0" * 32, "1" * 32) == "3451e42bdce0eab4549fc73883b4bbbd"


def test_options_of_the_method_are_those_of_each_cells_job(either: Services) -> None:
    actions.create(either, wanted(**ANNEALED))
    assert [(r.method, r.options) for r in requests_of(either)] == 4 * [("graspit", {"keep": 20, "steps": 40000})]
    with pytest.raises(errors.ConflictError, match="its options is"):
        actions.create(either, wanted(**ANNEALED | {"options": {"keep": 5}}))


def test_with_auto_each_cell_gets_what_the_chart_promises_for_it(either: Services) -> None:
    records.publish_record(either.store, "charts", chart())
    actions.create(either, wanted(**AUTO))
    assert [(r.fidelity, r.target) for r in requests_of(either)] == [(fidelity, "") for fidelity in CHOSEN]
    assert [cell.fidelity for cell in either.index.datasets.cells("grasps").items] == CHOSEN
    assert either.index.datasets.get("grasps").options.target == "gsr>=0.6"
    rebuild(either.index, either.store)
    assert [cell.fidelity for cell in either.index.datasets.cells("grasps").items] == CHOSEN


def test_a_later_chart_changes_nothing_of_a_dataset(services: Services) -> None:
    records.publish_record(services.store, "charts", chart())
    actions.create(services, wanted(**AUTO))
    before = jobs_of(services, "grasps")
    actions.create(services, wanted("named", fidelity="fine"))
    assert before[2:] == jobs_of(services, "named")[2:], "each is the job of that fidelity"
    records.publish_record(services.store, "charts", chart("2026-11-21T11:00:00.000Z", claw="draft"))
    _, new = actions.create(services, wanted(**AUTO))
    assert not new and jobs_of(services, "grasps") == before
    records.publish_record(services.store, "charts", {"created": "2026-11-21T12:00:00.000Z", "runs": []})
    assert actions.create(services, wanted(**AUTO))[1] is False


def test_auto_costs_what_it_chooses_and_needs_a_target_within_reach(services: Services) -> None:
    records.publish_record(services.store, "charts", chart())
    with pytest.raises(errors.InputError, match=r"no fidelity of fast_graspd meets gsr>=0\.75"):
        actions.create(services, wanted(**AUTO | {"target": "gsr>=0.75"}))
    assert not services.store.exists(names.dataset_record_key("grasps"))
    both = estimate(services.index, wanted(hands=("gripper",), **AUTO), FidelityResolver(services.store))
    apart = [
        estimate(services.index, wanted(hands=("gripper",), objects=(obj,), fidelity=fidelity))
        for obj, fidelity in (("ball", "standard"), ("cube", "draft"))
    ]
    assert both.seconds == pytest.approx(sum(one.seconds for one in apart))


def test_each_cell_in_scenes_says_how_its_fidelity_was_chosen(either: Services) -> None:
    measured = {"draft": {"ball": 0.8, "cube": 0.92}, "standard": {"ball": 0.95, "cube": 0.99}}
    of_each = [(name, obj, lift) for name, lifted in measured.items() for obj, lift in lifted.items()]
    speeds = {"draft": 20, "standard": 15}
    runs = [lifts(name, speeds[name], lift, hand="gripper", object=obj) for name, obj, lift in of_each]
    place = SceneSpec(kind="table")
    created = {"created": "2026-11-21T10:00:00.000Z", "scene": place.model_dump(mode="json")}
    key = records.publish_record(either.store, records.scene_chart_kind(place), created | {"runs": runs})
    actions.create(either, wanted(fidelity="auto", target="lift>=0.9", scene="table"))
    rebuild(either.index, either.store)
    cells = either.index.datasets.cells("grasps").items
    assert [cell.fidelity for cell in cells] == ["standard", "draft", "standard", "standard"]
    assert [(c.choice.measured_on, c.choice.reached, c.choice.chart) for c in cells if c.choice] == [
        (on, reached, key)
        for on, reached in [("hand and object", 0.95), ("hand and object", 0.92), ("all", 0.97), ("all", 0.97)]
    ]
    plan_all(either)
    assert [record_of(either, job).choice for job in jobs_of(either, "grasps")] == [cell.choice for cell in cells]
    assert len(records.load_dataset(either.store, "grasps").choices) == 3
