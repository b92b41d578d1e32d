"""What projects used, day by day, and whose turn it is when they share the queue."""

from __future__ import annotations

from service.index.rebuild import rebuild
from service.index.views import UsageDay
from service.model import names
from service.model.clock import timestamp
from service.model.messages import Origin
from service.model.planning import message_of, plan
from service.model.projects import Reach
from service.model.records import JobRecord
from service.model.states import AssetKind, Lane
from service.model.turns import Turns
from service.pipeline.backends import Parts
from service.store.records import put_record
from tests.fakes import make_shard, request

_PAIR = ((AssetKind.HAND, "gripper"), (AssetKind.OBJECT, "ball"))
DAY, NEXT = "2026-11-20", "2026-11-21"


def enter(parts: Parts, project: str, seed: int, *, key: str = "", batches: int = 1, where: int = 0) -> JobRecord:
    """A bulk job of a project, none of it in the queue; `where` is the first digit of its id."""
    hand, obj = (parts.index.assets.get(kind, name).digest for kind, name in _PAIR)
    record = JobRecord(
        id=f"{where:x}{seed:031x}",
        request=request(grasps=32 * batches, seed=seed),
        hand_digest=hand,
        object_digest=obj,
        lane=Lane.BULK,
        created=timestamp(),
        origin=Origin(key=key or project),
        project=project,
    )
    put_record(parts.store, names.job_record(record.id), record)
    parts.index.write.add_job(record)
    return record


def make(parts: Parts, record: JobRecord, *, day: str = DAY, device: str = "cuda:0", seconds: float = 10.0) -> int:
    """All tasks of a job, each so long on such a device; returns how many of its grasps are valid."""
    made = [make_shard(parts.store, message_of(record, task, attempt=1, max_attempt=3)) for task in plan(record)]
    told = {"created": f"{day}T12:00:00.000000Z", "device": device, "seconds": seconds}
    parts.index.write.add_manifests([manifest.model_copy(update=told) for manifest in made])
    return sum(manifest.valid or 0 for manifest in made)


def usage(project: str, day: str, *, batches: int, valid: int, gpu: float = 0.0, cpu: float = 0.0) -> UsageDay:
    return UsageDay(
        project=project, day=day, grasps=32 * batches, valid=valid, tasks=batches, gpu_seconds=gpu, cpu_seconds=cpu
    )


def test_what_was_made_is_summed_for_each_project_and_day(parts: Parts) -> None:
    red = make(parts, enter(parts, "red", 1, batches=3))
    red += make(parts, enter(parts, "red", 2), device="cpu", seconds=4.0)
    later = make(parts, enter(parts, "red", 3, batches=2), day=NEXT)
    blue = make(parts, enter(parts, "blue", 4), seconds=2.5)
    assert parts.index.usage.days(DAY, NEXT) == [
        usage("red", NEXT, batches=2, valid=later, gpu=20.0),
        usage("blue", DAY, batches=1, valid=blue, gpu=2.5),
        usage("red", DAY, batches=4, valid=red, gpu=30.0, cpu=4.0),
    ]
    assert parts.index.usage.days(DAY, DAY) == parts.index.usage.days(DAY, NEXT)[1:]
    assert parts.index.usage.days(DAY, NEXT, reach=Reach("blue", everything=False)) == [
        usage("blue", DAY, batches=1, valid=blue, gpu=2.5)
    ]


def test_gpu_seconds_of_a_day_are_those_of_gpu_workers_for_that_project(parts: Parts) -> None:
    make(parts, enter(parts, "red", 1, batches=3))
    make(parts, enter(parts, "red", 2), device="cpu")
    make(parts, enter(parts, "red", 3), day=NEXT)
    make(parts, enter(parts, "blue", 4))
    assert [parts.index.usage.gpu_seconds(*of) for of in (("red", DAY), ("red", NEXT), ("blue", DAY))] == [30, 10, 10]
    assert parts.index.usage.gpu_seconds("green", DAY) == 0


def test_a_shard_that_two_projects_asked_for_is_charged_to_the_first(parts: Parts) -> None:
    first = enter(parts, "red", 1)
    second = first.model_copy(update={"id": "f" * 32, "project": "blue"})
    parts.index.write.add_job(second)
    make(parts, first)
    (day,) = parts.index.usage.days(DAY, DAY)
    assert (day.project, day.tasks) == ("red", 1)


def test_what_was_deleted_stays_counted(parts: Parts) -> None:
    record = enter(parts, "red", 1, batches=2)
    make(parts, record)
    before = parts.index.usage.days(DAY, DAY)
    parts.index.removals.remove_job(record.id)
    with parts.index.database.writing() as connection:
        gone = [parts.index.removals.remove_shard(task.output, within=connection) for task in plan(record)]
    assert gone == [True, True]
    assert parts.index.usage.days(DAY, DAY) == before
    make(parts, enter(parts, "red", 2))
    (after,) = parts.index.usage.days(DAY, DAY)
    assert (after.tasks, after.gpu_seconds) == (3, 30.0), "and is added to what is there"


def test_usage_is_the_same_after_the_index_was_made_anew(parts: Parts) -> None:
    for seed, project in enumerate(("red", "blue")):
        record = enter(parts, project, seed)
        for task in plan(record):
            manifest = make_shard(parts.store, message_of(record, task, attempt=1, max_attempt=3))
            parts.index.write.add_manifest(manifest)
    before = parts.index.usage.days("2000-01-01", "2999-01-01")
    assert {day.project for day in before} == {"red", "blue"}
    rebuild(parts.index, parts.store)
    assert parts.index.usage.days("2000-01-01", "2999-01-01") == before


def test_projects_share_the_queue_evenly_whatever_their_keys_and_jobs_are(parts: Parts) -> None:
    for seed in range(6):
        enter(parts, "greedy", seed, key=f"greedy-{seed % 3}", batches=6, where=seed * 2)
    enter(parts, "modest", 9, batches=12, where=5)
    enter(parts, "", 10, key="alone", batches=12, where=13)
    turns = Turns()
    queued: dict[str, int] = {"greedy": 0, "modest": 0, "": 0}
    for room in (3, 6, 12, 9):  # as it comes up, round by round
        ready = parts.index.feed.ready_tasks(Lane.BULK, turns, now=2e9, limit=room)
        assert len(ready) == room
        parts.index.live.set_queued([task.task.id for task in ready])
        for task in ready:
            queued[parts.index.jobs.get(task.job.id).project] += 1
    assert queued == {"greedy": 10, "modest": 10, "": 10}
