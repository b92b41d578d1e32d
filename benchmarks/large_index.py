"""Index with a million grasps, filled in a minute: rows as from the pipeline, but no shard files.

usage: python -m benchmarks.large_index --data-dir DIR [--grasps 1000000] [--jobs 1000] [--index-url URL]

`GRASPD_DATA_DIR=DIR graspd api` (or `graspd up`, without workers) then shows it. In Python:
`fill(index, store, grasps=..., jobs=...)` on an empty index."""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np
from sqlalchemy import Connection, Table

from graspd.service.index.changes.records import derive_states, job_row, row_from, shard_row, task_rows
from graspd.service.index.database import upsert
from graspd.service.index.index import Index
from graspd.service.index.tables import attempts, grasps, jobs, metadata, shards, tasks
from graspd.service.model import names
from graspd.service.model.digests import digest_json, job_id
from graspd.service.model.domain import JobRequest
from graspd.service.model.metrics import IndexLevel, indexed_metrics
from graspd.service.model.planning import PlannedTask, plan_tasks
from graspd.service.model.records import AttemptRecord, JobRecord
from graspd.service.model.states import AssetKind, Priority, Stage, State
from graspd.service.model.version import PACKAGE_VERSION, STAGE_REVISIONS
from graspd.service.settings import Settings
from graspd.service.store.library import publish_builtins
from graspd.service.store.manifests import ShardManifest
from graspd.service.store.store import Store, open_store

_CHUNK: Final = 20_000
#: Number of jobs per hundred in each state; running jobs are half done.
_MIX: Final = {State.SUCCEEDED: 88, State.RUNNING: 4, State.QUEUED: 3, State.FAILED: 3, State.CANCELLED: 2}
#: Metrics of every grasp.
_NAMES: Final = tuple(metric.name for metric in indexed_metrics(IndexLevel.SORTED) if not metric.optional)
_SCALES: Final = dict(zip(_NAMES, (0.25, 0.8, 9.0, 0.3, 0.8, 0.1, 0.05), strict=True))


def fill(index: Index, store: Store, *, grasps: int = 1_000_000, jobs: int = 1000, seed: int = 0) -> dict[str, int]:
    """Publish the built-in hands and objects, and insert jobs of them with about `grasps` grasps in total.
    One job in ten has scenes and views. Submission times are spread over the last 30 days. Return the number of rows
    per table."""
    if index.jobs.page(limit=1).items:
        raise SystemExit("the index is not empty; give another data folder or database")
    for asset in publish_builtins(store):
        index.write.add_asset(asset, {"verdict": "accept", "message": "", "repairs": [], "facts": {}})
    maker = _Maker(index, grasps // jobs, jobs, np.random.default_rng(seed))
    with index.database.write_transaction() as connection:
        maker.insert(connection)
    with index.database.read_transaction() as connection:
        if connection.dialect.name == "postgresql":  # it would otherwise vacuum later
            own = ", ".join(metadata.tables)  # only the tables of the index
            connection.execution_options(isolation_level="AUTOCOMMIT").exec_driver_sql(f"VACUUM ANALYZE {own}")
    return maker.counts


class _Maker:
    def __init__(self, index: Index, grasps_a_job: int, jobs: int, random: np.random.Generator) -> None:
        # Unfinished jobs have fewer grasps than requested, other jobs have more.
        share = sum(_MIX[state] * _done_share(state) for state in _MIX) / sum(_MIX.values())
        self._grasps_a_job = max(1, round(grasps_a_job / share))
        self._jobs, self._random = jobs, random
        self._hands = index.assets.page(AssetKind.HAND).items
        self._objects = index.assets.page(AssetKind.OBJECT).items
        self._states = [state for state, n in _MIX.items() for _ in range(n)]
        self._now = datetime.now(UTC)
        self.counts = {"jobs": 0, "tasks": 0, "attempts": 0, "shards": 0, "grasps": 0}

    def insert(self, connection: Connection) -> None:
        records = [self._job(number) for number in range(self._jobs)]
        self._insert(connection, jobs, (self._job_row(record, state) for record, state in records))
        self._insert(connection, tasks, (row for record, state in records for row in self._tasks(record, state)))
        failed = [record for record, state in records if state is State.FAILED]
        self._insert(connection, attempts, (self._attempt(record) for record in failed))
        made = [
            (record, task)
            for record, state in records
            for task in plan_tasks(record)
            if task.batch < _done(record, state)
        ]
        self._insert(connection, shards, (self._shard(record, task) for record, task in made))
        base = [(record, task) for record, task in made if task.stage is Stage.SYNTHESIZE]
        with _without_indexes(connection, grasps):
            self._insert(connection, grasps, (row for record, task in base for row in self._grasps(record, task)))
        for record, _ in records:
            derive_states(connection, record.id)
        if connection.dialect.name == "sqlite":
            connection.exec_driver_sql("ANALYZE")

    def _job(self, number: int) -> tuple[JobRecord, State]:
        hand = self._hands[number % len(self._hands)]
        obj = self._objects[number // len(self._hands) % len(self._objects)]
        state = State.RUNNING if number >= self._jobs - 4 else self._states[number * 37 % len(self._states)]
        rich = {"scenes": 1, "views": 2} if number % 10 == 0 else {}
        request = JobRequest(hand=hand.name, object=obj.name, grasps=self._grasps_a_job, seed=number, **rich)
        record = JobRecord(
            id=job_id(request, hand.digest, obj.digest),
            request=request,
            hand_digest=hand.digest,
            object_digest=obj.digest,
            revisions=dict(STAGE_REVISIONS),
            priority=Priority.BULK,
            created=self._at(number, 0.0),
        )
        return record, state

    def _at(self, number: int, share: float) -> str:
        ago = timedelta(days=30) * (1 - (number + share) / self._jobs)
        return (self._now - ago).isoformat(timespec="milliseconds").replace("+00:00", "Z")

    @staticmethod
    def _job_row(record: JobRecord, state: State) -> dict[str, Any]:
        return job_row(record) | {"cancelled": state is State.CANCELLED}

    def _tasks(self, record: JobRecord, state: State) -> Iterator[dict[str, Any]]:
        done = _done(record, state)
        for row in task_rows(record):
            if row["batch"] < done:
                finished = self._at(record.request.seed, row["batch"] / max(1, done))
                row |= {"done": True, "worker": "worker-0", "device": "cpu", "seconds": 2.5, "finished": finished}
            elif state is State.FAILED and row["batch"] == done and row["position"] == 0:
                row |= {"last_attempt": 3, "exhausted": True, "reason": "the planner lost its way"}
            elif state is State.RUNNING and row["batch"] == done and row["position"] == 0:
                row |= {"state": State.RUNNING.value, "queued": True, "worker": "worker-0"}
            yield row

    def _attempt(self, record: JobRecord) -> dict[str, Any]:
        done = _done(record, State.FAILED)
        task = next(task for task in plan_tasks(record) if task.batch == done)
        attempt = AttemptRecord(
            task_id=task.id,
            job_id=record.id,
            stage=task.stage,
            number=3,
            kind="PlannerError",
            reason="the planner lost its way",
            worker="worker-0",
            ended=self._at(record.request.seed, 0.9),
            last=True,
        )
        return row_from(attempts, attempt, stage=task.stage.value)

    def _shard(self, record: JobRecord, task: PlannedTask) -> dict[str, Any]:
        kind = names.SHARD_KINDS[task.stage]
        axis = {"base": "N", "scene": "K", "views": "V"}[kind]
        manifest = ShardManifest.model_construct(
            shard_id=task.output,
            stage=task.stage,
            kind=kind,
            key=names.shard_file_key(task.stage, task.output),
            sha256=digest_json(task.output) * 2,
            size_bytes=40_000,
            counts={axis: task.count},
            hand=record.request.hand,
            object=record.request.object,
            hand_digest=record.hand_digest,
            object_digest=record.object_digest,
            request=record.request,
            seed=record.request.seed,
            batch=task.batch,
            inputs=task.inputs,
            code_version=PACKAGE_VERSION,
            stage_revision=STAGE_REVISIONS[task.stage],
            shard_schema=f"graspd/{kind}@1",
            created=self._at(record.request.seed, task.batch / 1000),
            device="cpu",
            seconds=2.5,
            worker="worker-0",
            valid=int(_validity(task).sum()),
            candidates=task.count if kind == "base" else 0,
            rechecked=0,
            recheck_held=0,
            index_threshold_m=0.005,
            grasps=(),
            info={},
        )
        return shard_row(manifest)

    def _grasps(self, record: JobRecord, task: PlannedTask) -> Iterator[dict[str, Any]]:
        created = self._at(record.request.seed, task.batch / 1000)
        columns = {
            name: self._random.gamma(2.0, scale / 2, task.count).round(6).tolist() for name, scale in _SCALES.items()
        }
        columns["contact_links"] = self._random.integers(2, 9, task.count).tolist()
        columns["valid"] = _validity(task).tolist()
        columns["success"] = (self._random.random(task.count) < 0.7).tolist()
        same = {
            "shard_id": task.output,
            "hand": record.request.hand,
            "object": record.request.object,
            "created": created,
        }
        for row, values in enumerate(zip(*columns.values(), strict=True)):
            yield same | {"row": row} | dict(zip(columns, values, strict=True))

    def _insert(self, connection: Connection, table: Table, rows: Iterable[dict[str, Any]]) -> None:
        for chunk in _chunks(rows):
            if connection.dialect.name == "postgresql":
                _copy(connection, table, chunk)
            else:
                upsert(connection, table, chunk)
            self.counts[table.name] += len(chunk)


def _done_share(state: State) -> float:
    return {State.RUNNING: 0.5, State.CANCELLED: 0.5, State.QUEUED: 0.0}.get(state, 1.0)


def _done(record: JobRecord, state: State) -> int:
    """Return the number of batches with all stages done; of a failed job, all but the last."""
    batches = -(-record.request.grasps // 32)
    return batches - 1 if state is State.FAILED else int(batches * _done_share(state))


def _validity(task: PlannedTask) -> Any:
    return np.random.default_rng(int(task.output[:8], 16)).random(task.count) < 0.8


def _chunks(rows: Iterable[dict[str, Any]]) -> Iterator[list[dict[str, Any]]]:
    rows = iter(rows)
    while chunk := list(itertools.islice(rows, _CHUNK)):
        yield chunk


def _copy(connection: Connection, table: Table, rows: Sequence[dict[str, Any]]) -> None:
    """Insert rows by PostgreSQL's bulk load, ten times as fast as INSERT."""
    columns = [column.name for column in table.columns if column.name in rows[0]]
    process = {
        name: table.c[name].type.dialect_impl(connection.dialect).bind_processor(connection.dialect) for name in columns
    }
    driver: Any = connection.connection.driver_connection
    quoted = ", ".join(f'"{name}"' for name in columns)
    with driver.cursor().copy(f'COPY "{table.name}" ({quoted}) FROM STDIN') as copy:
        for row in rows:
            copy.write_row([p(row[name]) if (p := process[name]) else row[name] for name in columns])


class _without_indexes:  # noqa: N801
    """Drop the secondary indexes of a table and recreate them after the block, for faster inserts."""

    def __init__(self, connection: Connection, table: Table) -> None:
        self._connection, self._table = connection, table

    def __enter__(self) -> None:
        for index in self._table.indexes:
            index.drop(self._connection)

    def __exit__(self, *_: object) -> None:
        for index in self._table.indexes:
            index.create(self._connection)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data-dir", type=Path, required=True)
    parser.add_argument("--index-url", help="PostgreSQL or another SQLite; default: in the data folder")
    parser.add_argument("--grasps", type=int, default=1_000_000)
    parser.add_argument("--jobs", type=int, default=1000)
    given = parser.parse_args()
    settings = Settings(data_dir=given.data_dir, **({"index_url": given.index_url} if given.index_url else {}))
    start = time.perf_counter()
    index = Index(settings.resolved_index_url)
    counts = fill(index, open_store(settings.resolved_store_url), grasps=given.grasps, jobs=given.jobs)
    sys.stdout.write(
        f"{', '.join(f'{n} {name}' for name, n in counts.items())} in {time.perf_counter() - start:.0f} s\n"
    )
    index.close()


if __name__ == "__main__":
    main()
