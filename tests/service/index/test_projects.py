"""What projects used, day by day, and whose turn it is when they share the queue."""

from graspd.service.index.rebuild import rebuild
from graspd.service.index.views import UsageDay
from graspd.service.model import names
from graspd.service.model.messages import Origin
from graspd.service.model.planning import RoundRobin, create_task_message, plan_tasks
from graspd.service.model.projects import ProjectScope
from graspd.service.model.records import JobRecord
from graspd.service.model.states import Priority
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.store.records import put_record
from tests.fakes import make_shard, make_task, request

DAY, NEXT = "2026-11-20", "2026-11-21"


def enter(services: Services, project: str, seed: int, *, key: str = "", batches: int = 1, where: int = 0) -> JobRecord:
    """A bulk job of a project, none of it in the queue; `where` is the first digit of its id."""
    record = job_actions.prepare_job(
        services, request(grasps=32 * batches, seed=seed), priority=Priority.BULK
    ).model_copy(update={"id": f"{where:x}{seed:031x}", "origin": Origin(key=key or project), "project": project})
    put_record(services.store, names.job_record_key(record.id), record)
    services.index.write.add_job(record)
    return record


def make(services: Services, record: JobRecord, *, day: str = DAY, device: str = "cuda:0", seconds: float = 10) -> int:
    made = [
        make_shard(services.store, create_task_message(record, task, attempt=1, max_attempt=3))
        for task in plan_tasks(record)
    ]
    told = {"created": f"{day}T12:00:00.000000Z", "device": device, "seconds": seconds}
    services.index.write.add_manifests([manifest.model_copy(update=told) for manifest in made])
    return sum(manifest.valid or 0 for manifest in made)


def usage(project: str, day: str, *, batches: int, gpu: float = 0.0, cpu: float = 0.0, **more: int) -> UsageDay:
    made = {"grasps": 32 * batches, "tasks": batches, "gpu_seconds": gpu, "cpu_seconds": cpu, **more}
    return UsageDay(project=project, day=day, **made)


def test_what_was_made_is_summed_for_each_project_and_day(services: Services) -> None:
    red = make(services, enter(services, "red", 1, batches=3))
    red += make(services, enter(services, "red", 2), device="cpu", seconds=4.0)
    later = make(services, enter(services, "red", 3, batches=2), day=NEXT)
    blue = make(services, enter(services, "blue", 4), seconds=2.5)
    assert services.index.usage.days(DAY, NEXT) == [
        usage("red", NEXT, batches=2, valid=later, gpu=20.0),
        usage("blue", DAY, batches=1, valid=blue, gpu=2.5),
        usage("red", DAY, batches=4, valid=red, gpu=30.0, cpu=4.0),
    ]
    assert services.index.usage.days(DAY, DAY) == services.index.usage.days(DAY, NEXT)[1:]
    assert services.index.usage.days(DAY, NEXT, scope=ProjectScope("blue", everything=False)) == [
        usage("blue", DAY, batches=1, valid=blue, gpu=2.5)
    ]
    for project, day, seconds in (("red", DAY, 30), ("red", NEXT, 20), ("blue", DAY, 2.5), ("green", DAY, 0)):
        assert services.index.usage.gpu_seconds(project, day) == seconds


def test_a_shard_that_two_projects_want_is_charged_to_the_first(services: Services) -> None:
    first = enter(services, "red", 1)
    second = first.model_copy(update={"id": "f" * 32, "project": "blue"})
    services.index.write.add_job(second)
    make(services, first)
    (day,) = services.index.usage.days(DAY, DAY)
    assert (day.project, day.tasks) == ("red", 1)


def test_what_was_deleted_stays_counted(services: Services) -> None:
    record = enter(services, "red", 1, batches=2)
    make(services, record)
    before = services.index.usage.days(DAY, DAY)
    services.index.removals.remove_job(record.id)
    with services.index.database.write_transaction() as connection:
        gone = [services.index.removals.remove_shard(task.output, within=connection) for task in plan_tasks(record)]
    assert gone == [True, True]
    assert services.index.usage.days(DAY, DAY) == before
    make(services, enter(services, "red", 2))
    (after,) = services.index.usage.days(DAY, DAY)
    assert (after.tasks, after.gpu_seconds) == (3, 30.0), "and is added to what is there"


def test_usage_is_the_same_after_the_index_was_made_anew(services: Services) -> None:
    for seed, project in enumerate(("red", "blue")):
        for task in plan_tasks(record := enter(services, project, seed)):
            make_task(services, record, task)
    before = services.index.usage.days("2000-01-01", "2999-01-01")
    assert {day.project for day in before} == {"red", "blue"}
    rebuild(services.index, services.store)
    assert services.index.usage.days("2000-01-01", "2999-01-01") == before


def test_projects_share_the_queue_evenly(services: Services) -> None:
    for seed in range(6):
        enter(services, "greedy", seed, key=f"greedy-{seed % 3}", batches=6, where=seed * 2)
    enter(services, "modest", 9, batches=12, where=5)
    enter(services, "", 10, key="alone", batches=12, where=13)
    turns = RoundRobin()
    queued: dict[str, int] = {"greedy": 0, "modest": 0, "": 0}
    for room in (3, 6, 12, 9):  # as it comes up, round by round
        ready = services.index.feed.ready_tasks(Priority.BULK, turns, now=2e9, limit=room)
        assert len(ready) == room
        services.index.live.set_queued([task.task.id for task in ready])
        for task in ready:
            queued[services.index.jobs.get(task.job.id).project] += 1
    assert queued == {"greedy": 10, "modest": 10, "": 10}
