"""What the index adds up: usage of projects, fair scheduling, statistics held against NumPy; its tables as Parquet."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import insert, select

from graspd.service.index.export import TABLES, export
from graspd.service.index.index import Index
from graspd.service.index.queries.grasps import GraspFilter
from graspd.service.index.rebuild import rebuild
from graspd.service.index.tables import METRICS, grasps, shards
from graspd.service.index.views import UsageDay
from graspd.service.model import names
from graspd.service.model.errors import InputError
from graspd.service.model.messages import Origin
from graspd.service.model.planning import RoundRobin, create_task_message, plan_tasks
from graspd.service.model.projects import ProjectScope
from graspd.service.model.records import JobRecord
from graspd.service.model.states import Priority
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.store.records import put_record
from tests.fakes import make_shard, make_task, request
from tests.indexes import empty_index

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
    services.index.write.add_job(first.model_copy(update={"id": "f" * 32, "project": "blue"}))
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


COUNT = 500
BINS = 12
CREATED = "2026-01-01T00:00:00Z"


@pytest.fixture
def values() -> np.ndarray:
    return np.random.default_rng(7).gamma(2.0, 0.3, COUNT)


@pytest.fixture
def index(tmp_path: Path, values: np.ndarray) -> Iterator[Index]:
    opened = empty_index(f"sqlite:///{tmp_path / 'index.sqlite'}")
    plain = dict.fromkeys(METRICS) | {"shard_id": "a" * 32, "hand": "h", "object": "o", "created": CREATED}
    rows = [plain | {"row": row, "epsilon": value, "valid": row % 2 == 0} for row, value in enumerate(values)]
    with opened.database.write_transaction() as connection:
        connection.execute(insert(grasps), rows)
    yield opened
    opened.close()


def test_distributions_of_few_grasps_are_exact(index: Index, values: np.ndarray) -> None:
    found = index.statistics.compare_distributions(
        [GraspFilter(valid=True)], ("epsilon", "contact_area_cm2"), bins=BINS
    )
    passed = values[::2]
    ((one,),) = found.values()
    assert one is not None and one.counts == np.histogram(passed, BINS)[0].tolist()
    assert (one.count, one.low, one.high) == (len(passed), passed.min(), passed.max())
    assert one.mean == pytest.approx(passed.mean())
    assert index.statistics.compare_distributions([GraspFilter(hand="other")], ("epsilon",)) == {}


def test_distributions_of_many_grasps_come_from_a_fair_sample(index: Index) -> None:
    with index.database.write_transaction() as connection:
        for number in range(400):
            shard = hashlib.sha256(str(number).encode()).hexdigest()[:32]
            made = {"shard_id": shard, "hand": "a", "object": "b", "created": CREATED, "valid": True}
            connection.execute(insert(grasps), [made | {"row": row, "epsilon": number / 400} for row in range(8)])
            connection.execute(insert(shards), _shard(shard, hand="a", object="b", count=8))
    (found,) = index.statistics.compare_distributions([GraspFilter(hand="a", object="b")], ("epsilon",), at_most=800)[
        "epsilon"
    ]
    # 100 shards are expected; the number drawn has a standard deviation of 9, their mean one of 0.03.
    assert found is not None and 60 * 8 < found.count < 140 * 8
    assert found.mean == pytest.approx(0.5, abs=0.12)


def _shard(shard: str, **fields: object) -> dict[str, object]:
    texts = dict.fromkeys(("key", "sha256", "hand_digest", "object_digest", "device", "worker", "created"), "x")
    numbers = dict.fromkeys(("size_bytes", "valid", "batch", "seed", "seconds"), 0)
    return {"id": shard, "kind": "base", "stage": "synthesize", "inputs": [], "manifest": {}} | texts | numbers | fields


def test_every_row_and_value_of_a_table_is_in_its_file(services: Services, tmp_path: Path, monkeypatch) -> None:
    pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed; pip install 'graspd[parquet]'")
    monkeypatch.setattr("graspd.service.index.export.GROUP", 7)  # several groups of rows, the last one not full
    make(services, enter(services, "vision", 1, batches=2))
    counts = export(services.index.database, tmp_path)
    assert counts["grasps"] == 64 and counts["jobs"] == 1 and counts["shards"] == counts["tasks"] > 1
    with services.index.database.read_transaction() as connection:
        for name, table in TABLES.items():
            stored = [
                {key: json.dumps(value) if isinstance(value, dict | list) else value for key, value in row.items()}
                for row in connection.execute(select(table).order_by(*table.primary_key.columns)).mappings()
            ]
            found = pq.read_table(tmp_path / f"{name}.parquet")
            assert found.schema.names == [column.name for column in table.columns], "also of a table without rows"
            assert found.to_pylist() == stored
            assert len(stored) == counts[name]


def test_no_table_holds_what_is_secret(services: Services, tmp_path: Path) -> None:
    columns = {column.name for table in TABLES.values() for column in table.columns}
    assert not {name for name in columns if "secret" in name or "token" in name or "url" in name}


def test_without_pyarrow_the_fix_is_told(services: Services, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"graspd\[parquet\]"):
        export(services.index.database, tmp_path)
