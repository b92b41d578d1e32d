"""The index: what the API asks of it, that it holds the same rows as a rebuild, and several that write it at once."""

import contextlib
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from pydantic import SecretStr
from sqlalchemy import delete, insert, select, update

from graspd.service.index import tables
from graspd.service.index.index import Index
from graspd.service.index.queries.grasps import GraspFilter, GraspSort
from graspd.service.index.rebuild import differences, rebuild
from graspd.service.index.views import GraspView
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import ConflictError, IndexUnavailable, InputError, StoreUnavailable
from graspd.service.model.planning import OUTCOMES, RoundRobin, create_task_message, plan_tasks
from graspd.service.model.states import AssetKind, Priority, Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.store.store import Store, open_store
from tests.fakes import fail_task, finish, make_shard, make_task, record_of, request, with_settings
from tests.servers import PostgresServer
from tests.service.conftest import service
from tests.service.index.test_projects import enter


@pytest.fixture
def services(tmp_path: Path, index_url: str) -> Iterator[Services]:
    """A service on an index of each kind in turn."""
    yield from service(tmp_path, open_store("memory://"), index_url=SecretStr(index_url))


def fail(services: Services, job: str, batch: int, number: int, *, last: bool) -> None:
    """A failed attempt at the first stage of a batch."""
    task = services.index.jobs.tasks(job=job).items[batch]
    fail_task(services, job, task, number, last=last, reason=f"attempt {number} went wrong")


def test_sqlite_lets_readers_read_while_one_writes(services: Services) -> None:
    with services.index.database.write_transaction() as connection:
        connection.execute(update(tables.assets).values(message="half done"))
        assert {a.message for a in services.index.assets.page(AssetKind.HAND).items} == {"fine"}


def test_a_database_that_cannot_be_opened_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(IndexUnavailable, match="unable to open database file"):
        Index(f"sqlite:///{tmp_path}")


def test_a_job_shows_progress_by_stage(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=64, scenes=1))
    task = services.index.jobs.tasks(job=job.id).items[0]
    services.index.live.set_running({task.id: "w"})
    services.index.live.set_progress({task.id: (1.0, 4.0, "descending")})
    shown = services.index.jobs.get(job.id)
    assert shown.state is State.RUNNING
    told = [(stage.stage, stage.tasks, stage.running, stage.done) for stage in shown.stages]
    assert told == [("synthesize", 2, 1, 0.25), ("scene", 2, 0, 0)]
    finish(services, job.id)
    done = services.index.jobs.get(job.id)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 64)
    assert done.valid == len(services.index.grasps.page(GraspFilter(job=job.id, valid=True), limit=200).items)
    assert done.finished is not None


def test_a_job_that_found_fewer_grasps_tells_the_outcomes(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=64))
    record = record_of(services, job.id)
    for task, lost in zip(plan_tasks(record), ({"slipped": 3, "turned": 1}, {"slipped": 4}), strict=True):
        make_task(services, record, task, outcomes=lost)
    done = services.index.jobs.get(job.id)
    assert done.valid < 64 and done.outcomes == {"turned": 1, "slipped": 7}
    assert done.note is not None and f"found {done.valid} of 64 valid grasps" in done.note
    assert f"7 slipped, 1 {OUTCOMES['turned']}" in done.note
    (listed,) = services.index.jobs.page().items
    assert listed.note is not None and not listed.outcomes


def test_verdicts_of_a_second_engine_are_counted(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=64, second_engine="physx"))
    for task in plan_tasks(record := record_of(services, job.id)):
        make_task(services, record, task, second_engine={"second_tested": 4, "second_held": 3})
    done = services.index.jobs.get(job.id)
    assert (done.second_tested, done.second_held) == (8, 6)


def test_jobs_are_chosen_by_id_state_hand_and_object(services: Services) -> None:
    job, _ = job_actions.submit(services, request())
    found = services.index.jobs.page(state=State.QUEUED, hand="gripper", object="ball", prefix=job.id[:4]).items
    assert [one.id for one in found] == [job.id]
    for other in ({"state": State.FAILED}, {"hand": "other"}, {"object": "other"}, {"prefix": "%"}):
        assert services.index.jobs.page(**other).items == []


def all_pages(services: Services, where: GraspFilter | None = None, *, limit: int, **query: Any) -> list[GraspView]:
    """Grasps of every page of a query."""
    page = services.index.grasps.page(where or GraspFilter(), limit=limit, **query)
    seen = page.items
    while page.next is not None:
        page = services.index.grasps.page(where or GraspFilter(), limit=limit, cursor=page.next, **query)
        seen += page.items
    return seen


def test_grasps_page_through_in_the_order_of_any_metric(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=70))
    finish(services, job.id)
    metrics = ("epsilon", "penetration_depth_mm", "stability_loss")
    with services.index.database.write_transaction() as connection:  # some without the metrics
        connection.execute(update(tables.grasps).where(tables.grasps.c.row < 3).values(dict.fromkeys(metrics)))
    for by, descending in itertools.product((*metrics, "created"), (True, False)):
        sort = GraspSort(by=by, descending=descending)  # type: ignore[arg-type]
        seen = all_pages(services, limit=16, sort=sort)
        assert len({(g.shard_id, g.row) for g in seen}) == len(seen) == 70, sort
        values = [getattr(grasp, by) for grasp in seen]
        known = [value for value in values if value is not None]
        assert known == sorted(known, reverse=descending), sort
        assert values[: len(known)] == known, f"{sort}: those without the metric come last"


def test_grasps_are_chosen_by_their_contacts(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=32))
    finish(services, job.id)
    contacts = {"taxonomy_type": 14, "digits": 7, "region_share": 0.97}
    with services.index.database.write_transaction() as connection:
        connection.execute(update(tables.grasps).where(tables.grasps.c.row < 3).values(contacts))
    where = GraspFilter(where="taxonomy_type = 14 and digits = 7 and region_share >= 0.95")
    assert [one.model_dump(include=set(contacts)) for one in all_pages(services, where, limit=9)] == [contacts] * 3


def test_failures_are_grouped_by_stage_and_error(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=64))
    fail(services, job.id, 0, 1, last=False)
    fail(services, job.id, 0, 2, last=False)
    fail(services, job.id, 1, 1, last=False)
    (group,) = services.index.overview.failures()
    assert (group.stage, group.kind, group.attempts, group.tasks) == ("synthesize", "ValueError", 3, 2)
    assert len(services.index.jobs.attempts(job=job.id)) == 3


def test_the_service_in_numbers(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=64, scenes=1))
    before = timestamp()
    finish(services, job.id, batches=1)
    stats = services.index.overview.stats()
    assert (stats.grasps, stats.shards) == (32, 2) and stats.tasks[State.SUCCEEDED] == 2
    assert stats.jobs[State.RUNNING] == 1
    (cell,) = services.index.overview.matrix()
    assert (cell.hand, cell.object, cell.jobs, cell.grasps, cell.queued) == ("gripper", "ball", 1, 32, 2)
    assert sum(services.index.overview.valid_per_minute(since=before).values()) == stats.valid > 0


def test_the_jobs_of_a_key_are_fed_in_turn_batch_by_batch(services: Services) -> None:
    small = with_settings(services, queue_window=1)
    for seed in range(2):
        job_actions.submit(small, request(grasps=320, seed=seed), priority=Priority.BULK)
    ready = services.index.feed.ready_tasks(Priority.BULK, RoundRobin(), now=time.time(), limit=10)
    assert len(ready) == 10
    for job in {task.job.id for task in ready}:
        batches = [task.task.batch for task in ready if task.job.id == job]
        assert batches == sorted(batches) and len(batches) == 5
    assert len({task.job.id for task in ready[:2]}) == 2


def test_a_key_with_many_jobs_gets_no_more_turns(services: Services) -> None:
    for seed in range(5):
        enter(services, "", seed, key="greedy", batches=20)
    enter(services, "", 9, key="modest", batches=20)
    turns = RoundRobin()
    owners: list[str] = []
    for limit in (1, 2, 3, 10, 4):  # room as it comes up, round by round
        ready = services.index.feed.ready_tasks(Priority.BULK, turns, now=time.time(), limit=limit)
        services.index.live.set_queued([task.task.id for task in ready])
        owners += [task.job.origin.key for task in ready if task.job.origin is not None]
    assert owners.count("greedy") == owners.count("modest") == 10


def test_a_clock_set_back_does_not_strand_a_task(services: Services) -> None:
    job, _ = job_actions.submit(services, request())
    task = services.index.jobs.tasks(job=job.id).items[0]
    a_year = 365 * 86400
    services.index.live.set_waiting([task.id], not_before=time.time() + 60)
    assert services.index.feed.ready_tasks(Priority.INTERACTIVE, RoundRobin(), now=time.time(), limit=9) == []
    services.index.live.set_waiting([task.id], not_before=time.time() + a_year)
    assert len(services.index.feed.ready_tasks(Priority.INTERACTIVE, RoundRobin(), now=time.time(), limit=9)) == 1


def test_two_jobs_that_need_one_shard_both_profit_from_it(services: Services) -> None:
    plain, _ = job_actions.submit(services, request())
    with_scenes, _ = job_actions.submit(services, request(scenes=1))
    finish(services, plain.id)
    assert services.index.jobs.get(plain.id).state is State.SUCCEEDED
    stages = services.index.jobs.get(with_scenes.id).stages
    assert [stage.succeeded for stage in stages] == [1, 0]
    later, _ = job_actions.submit(services, request(scenes=2))
    assert [stage.succeeded for stage in services.index.jobs.get(later.id).stages] == [1, 0]
    assert services.index.overview.stats().grasps == 32, "it is one shard"


def build_a_history(services: Services) -> None:
    """Jobs in every state: done, failed, failed and retried, cancelled, cancelled and retried, half done."""
    done, _ = job_actions.submit(services, request(grasps=70, scenes=1))
    finish(services, done.id)
    half, _ = job_actions.submit(services, request(grasps=64, scenes=1, seed=1))
    finish(services, half.id, batches=1, stage=Stage.SYNTHESIZE)
    failed, _ = job_actions.submit(services, request(seed=2, scenes=1))
    fail(services, failed.id, 0, 1, last=False)
    fail(services, failed.id, 0, 2, last=True)
    retried, _ = job_actions.submit(services, request(seed=3, scenes=1))
    fail(services, retried.id, 0, 1, last=True)
    job_actions.retry(services, retried.id)
    fail(services, retried.id, 0, 2, last=False)
    cancelled, _ = job_actions.submit(services, request(seed=4, grasps=64))
    finish(services, cancelled.id, batches=1)
    job_actions.cancel(services, cancelled.id)
    again, _ = job_actions.submit(services, request(seed=5))
    fail(services, again.id, 0, 1, last=False)
    job_actions.cancel(services, again.id)
    job_actions.retry(services, again.id)
    running, _ = job_actions.submit(services, request(seed=6))
    services.index.live.set_running({services.index.jobs.tasks(job=running.id).items[0].id: "w"})
    shared, _ = job_actions.submit(services, request(seed=2))
    finish(services, shared.id)


def test_a_rebuild_gives_the_rows_that_are_there_or_leaves_the_old_ones(
    services: Services, monkeypatch: pytest.MonkeyPatch
) -> None:
    build_a_history(services)

    def rows() -> tuple[object, ...]:
        jobs = [job.id for job in services.index.jobs.page(limit=99).items]
        return jobs, services.index.grasps.page(limit=200), services.index.shards.page(limit=200)

    states = {job.state for job in services.index.jobs.page(limit=99).items}
    assert states == {State.SUCCEEDED, State.RUNNING, State.QUEUED, State.CANCELLED}
    assert differences(services.index, services.store) == []
    before = rows()
    rebuild(services.index, services.store)
    assert differences(services.index, services.store) == []
    assert rows() == before
    jobs = len(services.index.jobs.page(limit=99).items)
    monkeypatch.setattr(Store, "get", Mock(side_effect=StoreUnavailable("away")))
    with pytest.raises(StoreUnavailable):
        rebuild(services.index, services.store)
    assert len(services.index.jobs.page(limit=99).items) == jobs


def test_every_kind_of_damage_to_the_index_is_seen_and_mended(services: Services) -> None:
    build_a_history(services)
    with services.index.database.write_transaction() as connection:
        connection.execute(delete(tables.grasps).where(tables.grasps.c.row == 0))
        connection.execute(update(tables.shards).values(seconds=99.0))
        connection.execute(update(tables.tasks).where(tables.tasks.c.done.is_(True)).values(state="failed"))
        connection.execute(insert(tables.object_sets).values(name="x", digest="x", objects=[], created="x"))
    found = differences(services.index, services.store)
    assert {line.split()[0] for line in found} >= {"grasps", "shards", "object_sets"}
    for words in ("not in the index", "not in the store", "in the store "):
        assert any(words in line for line in found)
    rebuild(services.index, services.store)
    assert differences(services.index, services.store) == []


#: What is searched for, and the ways of the search: what it sorts at once, and how many rows it looks at in turn.
SEARCHED = [
    GraspFilter(valid=True, at_least={"epsilon": 0.2}, at_most={"penetration_depth_mm": 2.5}),
    GraspFilter(hand="gripper", valid=False, at_least={"contact_area_cm2": 0.5}),
    GraspFilter(object="ball", at_most={"epsilon": 0.4}, at_least={"wrench_volume": 0.6}),
    GraspFilter(valid=True, at_least={"epsilon": 0.97, "contact_area_cm2": 0.97}),
    GraspFilter(hand="gripper", object="ball"),
    GraspFilter(hand="gripper", object="cube"),
]
WAYS: list[tuple[int, tuple[int, ...]]] = [(1000, (8, 16)), (0, (8, 16)), (0, (1000,))]


@pytest.mark.parametrize("sort", [GraspSort(), GraspSort(by="penetration_depth_mm", descending=False)])
def test_every_search_finds_the_same(services: Services, monkeypatch: pytest.MonkeyPatch, sort: GraspSort) -> None:
    job, _ = job_actions.submit(services, request(grasps=160))
    finish(services, job.id)
    everything = services.index.grasps.page(sort=sort, limit=200).items
    for where, (sorted_at_once, looked_at) in itertools.product(SEARCHED, WAYS):
        passing = [
            grasp
            for grasp in everything
            if where.valid in (None, grasp.valid)
            and where.object in (None, "ball")
            and all(getattr(grasp, name) >= bound for name, bound in where.at_least.items())
            and all(getattr(grasp, name) <= bound for name, bound in where.at_most.items())
        ]
        monkeypatch.setattr("graspd.service.index.queries.grasps.SORTED_AT_ONCE", sorted_at_once)
        monkeypatch.setattr("graspd.service.index.queries.grasps.LOOKED_AT", looked_at)
        assert all_pages(services, where, sort=sort, limit=7) == passing, (where, sorted_at_once, looked_at)


def test_valid_grasps_add_up_minute_by_minute(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=128, scenes=1))
    finish(services, job.id)
    hour = "2026-05-01T{:02}:{:02}:{:02}.123Z"
    times = [hour.format(7, 59, 59), hour.format(8, 0, 0), hour.format(8, 0, 44), hour.format(9, 30, 1)]
    base = tables.shards.c.kind == "base"
    with services.index.database.write_transaction() as connection:
        made = connection.execute(select(tables.shards.c.id, tables.shards.c.valid).where(base)).all()
        for (shard, _), created in zip(made, times, strict=True):
            connection.execute(update(tables.shards).where(tables.shards.c.id == shard).values(created=created))
    late, early, second, last = (valid for _, valid in made)
    assert early and second
    expected = {"2026-05-01T07:59": late, "2026-05-01T08:00": early + second, "2026-05-01T09:30": last}
    assert services.index.overview.valid_per_minute(since="2026-05-01T00:00") == expected
    assert services.index.overview.valid_per_minute(since="2026-05-01T09:30") == {"2026-05-01T09:30": last}


def test_writers_at_once_leave_the_rows_of_the_store(services: Services, index_url: str) -> None:
    """The controller indexes shards while the API of another process cancels and retries their job, over and over."""
    job, _ = job_actions.submit(services, request(grasps=32 * 6, scenes=1))
    record = record_of(services, job.id)
    messages = [create_task_message(record, task, attempt=1, max_attempt=3) for task in plan_tasks(record)]
    other = Services(services.settings, services.store, Index(index_url), services.queue)
    done = threading.Event()

    def interfere(change: Callable[[Services, str], object]) -> None:
        while not done.is_set():
            with contextlib.suppress(ConflictError):
                change(other, job.id)
            done.wait(0.1)

    threads = [threading.Thread(target=interfere, args=(change,)) for change in (job_actions.cancel, job_actions.retry)]
    for thread in threads:
        thread.start()
    try:
        for message in messages:
            services.index.write.add_manifests([make_shard(services.store, message)])
    finally:
        done.set()
        for thread in threads:
            thread.join()
        other.index.close()
    assert services.index.overview.stats().tasks[State.SUCCEEDED] == 12
    assert services.index.jobs.get(job.id).state is State.SUCCEEDED
    assert differences(services.index, services.store) == []


def test_text_that_a_database_would_refuse_stops_nothing(services: Services) -> None:
    job, _ = job_actions.submit(services, request())
    task = services.index.jobs.tasks(job=job.id).items[0]
    long = "w" * 200 + "\0"
    services.index.live.set_running({task.id: long})
    services.index.live.set_progress({task.id: (1.0, 2.0, "half\0way")})
    assert services.index.jobs.task(task.id).message == "halfway"
    fail_task(services, job.id, task, kind="K" * 100, reason="a\0b", trace="\0", worker=long)
    assert services.index.jobs.get(job.id).reason == "ab"
    assert differences(services.index, services.store) == []


@pytest.mark.postgres
def test_what_a_database_cannot_hold_is_not_taken_for_an_outage(postgres_server: PostgresServer) -> None:
    index = Index(postgres_server.database())
    with pytest.raises(InputError, match="cannot store"), index.database.write_transaction() as connection:
        connection.execute(tables.workers.insert().values(name="x" * 999))
    index.close()


@pytest.mark.postgres
def test_a_database_of_another_encoding_is_refused_with_the_mend(postgres_server: PostgresServer) -> None:
    postgres_server._ask("CREATE DATABASE plain ENCODING 'SQL_ASCII' LC_COLLATE 'C' LC_CTYPE 'C' TEMPLATE template0")
    with pytest.raises(InputError, match=r"encoding SQL_ASCII.*createdb --encoding UTF8 --template template0 plain"):
        Index(postgres_server.url("plain"))
