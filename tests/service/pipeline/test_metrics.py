"""What is told to Prometheus: true numbers, at a cost that does not grow with queue or index."""

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.dialects import sqlite

from graspd.api.metrics import Metrics, MetricsSnapshot
from graspd.service.index.notes import Damage
from graspd.service.index.queries import overview
from graspd.service.model.clock import timestamp
from graspd.service.model.messages import TaskMessage
from graspd.service.model.series import SERIES, field_name
from graspd.service.model.states import Priority, Stage, State
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.indexer import MOST_KINDS, OTHER_KIND, Tally
from graspd.service.pipeline.job_actions import submit
from graspd.service.queue.rq_queue import WORKERS, RqQueue, worker_key
from tests.conftest import REPOSITORY
from tests.fakes import beat_of, make_shard, message_for, request
from tests.indexes import empty_index


def tasks(count: int) -> list[TaskMessage]:
    return [message_for().model_copy(update={"task_id": f"{number:032x}"}) for number in range(count)]


@pytest.mark.parametrize(
    "query",
    [
        overview.job_count_query(State.QUEUED),
        overview.oldest_job_query(State.RUNNING),
        overview.grasp_count_query(timestamp()),
    ],
)
def test_no_read_of_the_index_for_metrics_scans_a_table(tmp_path: Path, query: Any) -> None:
    index = empty_index(f"sqlite:///{tmp_path / 'index.sqlite'}")
    text = str(query.compile(dialect=sqlite.dialect(), compile_kwargs={"literal_binds": True}))
    with index.database.read_transaction() as connection:
        steps = [row[3] for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {text}")]
    index.close()
    tables = [step for step in steps if re.search(r"\b(jobs|shards)\b", step)]
    assert tables
    assert all(step.startswith("SEARCH") and "USING" in step for step in tables)


def test_damage_of_the_store_is_told(services: Services) -> None:
    assert overview.read_index_status(services.index.database).damaged == 0
    services.index.damage.update([Damage("shards/base/a.h5", "its file is missing", "a")])
    assert overview.read_index_status(services.index.database).damaged == 1
    shown = MetricsSnapshot()
    shown.add_index(overview.read_index_status(services.index.database))
    assert b"graspd_store_damaged 1.0" in Metrics().render(shown)


def test_unfinished_jobs_and_the_latest_yield_are_told(services: Services) -> None:
    submit(services, request(grasps=32))
    manifest = make_shard(services.store, message_for())
    services.index.write.add_manifests([manifest])
    found = overview.read_index_status(services.index.database)
    assert found.jobs[State.QUEUED] == 1
    assert 0 <= found.oldest_s[State.QUEUED] < 60
    assert found.grasps_per_s == pytest.approx(manifest.count / 60)
    assert found.valid_per_s == pytest.approx(manifest.valid / 60)


def test_depth_age_and_workers_are_told_from_redis(rq_queue: RqQueue) -> None:
    rq_queue.enqueue(tasks(2), Priority.BULK)
    rq_queue.connection.sadd(WORKERS, "w1", "gone")
    rq_queue.connection.set(worker_key("w1"), json.dumps(asdict(beat_of("w1", state="busy"))), px=400_000)
    found = rq_queue.status(lease_s=600)
    place = (Priority.BULK, Stage.SYNTHESIZE)
    assert found.depth[place] == 2
    assert 0 <= found.oldest_s[place] < 60
    assert set(found.workers) == {"w1"} and found.workers["w1"][0].state == "busy"
    assert 200.0 <= found.workers["w1"][1] < 400.0


def test_the_cost_of_a_look_does_not_grow_with_the_queue(rq_queue: RqQueue) -> None:
    def commands() -> int:
        before = rq_queue.connection.info("commandstats")
        rq_queue.status(lease_s=6)
        after = rq_queue.connection.info("commandstats")
        return sum(after[name]["calls"] - before.get(name, {"calls": 0})["calls"] for name in after)

    rq_queue.enqueue(tasks(1), Priority.BULK)
    few = commands()
    rq_queue.enqueue(tasks(40), Priority.BULK)
    assert commands() == few


def test_sums_outlive_the_process_that_counts(rq_queue: RqQueue) -> None:
    for _ in range(2):
        tally = Tally(rq_queue.add_to_counters)
        tally.add("graspd_jobs_ended_total", "succeeded")
        tally.flush()
        tally.flush()
    assert rq_queue.counter_sums() == {'["graspd_jobs_ended_total", "succeeded"]': 2.0}


def test_a_shard_counts_its_grasps_and_its_seconds(services: Services) -> None:
    sums: dict[str, float] = {}
    tally = Tally(sums.update)
    manifest = make_shard(services.store, message_for())
    tally.count_shards([manifest])
    tally.flush()
    assert sums[field_name("graspd_grasps_total", "all")] == 32
    assert sums[field_name("graspd_grasps_total", "valid")] == manifest.valid
    assert sums[field_name("graspd_stage_seconds_bucket", "synthesize", "1.0")] == 1
    assert sums[field_name("graspd_stage_seconds_sum", "synthesize")] == pytest.approx(manifest.seconds)


def test_error_names_cannot_become_series_without_end() -> None:
    sums: dict[str, float] = {}
    tally = Tally(sums.update)
    for number in range(3 * MOST_KINDS):
        tally.count_failure("scene", f"Error{number}")
    tally.flush()
    assert len(sums) == MOST_KINDS + 1
    assert sums[field_name("graspd_task_failures_total", "scene", OTHER_KIND)] == 2 * MOST_KINDS


def test_the_page_of_metrics_asks_only_for_series_that_exist() -> None:
    text = (REPOSITORY / "docs" / "reference" / "metrics.md").read_text()
    questions = text[text.index("```promql") :]
    named = {name.removesuffix("_bucket") for name in re.findall(r"graspd_[a-z_]+", questions)}
    assert named <= set(SERIES)
