"""The index as the API and the keeper see it."""

from __future__ import annotations

from typing import Literal

from service.domain import AssetKind, Lane, Stage, State
from service.index.filters import GraspFilter, GraspSort
from service.index.views import (
    AssetView,
    AttemptView,
    FailureGroup,
    GraspView,
    JobView,
    MatrixCell,
    Page,
    ShardView,
    Stats,
    TaskView,
    Throughput,
    WorkerView,
)


class Index:
    """Reads for the API; `url` is an SQLAlchemy URL. Methods raise IndexUnavailable when the database is away.

    Cursors are opaque; `limit` is cut to 200; lists of jobs, shards and assets come newest first.
    """

    def __init__(self, url: str) -> None:
        """Connects and migrates to the present schema."""
        raise NotImplementedError

    def ping(self) -> float:
        """Seconds a query takes."""
        raise NotImplementedError

    def jobs(
        self,
        *,
        state: State | None = None,
        hand: str | None = None,
        object: str | None = None,
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[JobView]:
        raise NotImplementedError

    def job(self, job_id: str) -> JobView:
        raise NotImplementedError

    def tasks(
        self,
        *,
        job: str | None = None,
        stage: Stage | None = None,
        state: State | None = None,
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[TaskView]:
        raise NotImplementedError

    def attempts(self, *, job: str | None = None, task: str | None = None, limit: int = 50) -> list[AttemptView]:
        raise NotImplementedError

    def grasps(
        self,
        where: GraspFilter | None = None,
        *,
        sort: GraspSort = GraspSort(),
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[GraspView]:
        raise NotImplementedError

    def grasp_count(self, where: GraspFilter) -> int:
        raise NotImplementedError

    def shards(
        self,
        *,
        job: str | None = None,
        kind: Literal["base", "scene", "views"] | None = None,
        hand: str | None = None,
        object: str | None = None,
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[ShardView]:
        raise NotImplementedError

    def shard(self, shard_id: str) -> ShardView:
        raise NotImplementedError

    def assets(self, kind: AssetKind, *, limit: int = 50, cursor: str | None = None) -> Page[AssetView]:
        raise NotImplementedError

    def asset(self, kind: AssetKind, name_or_digest: str) -> AssetView:
        raise NotImplementedError

    def workers(self) -> list[WorkerView]:
        raise NotImplementedError

    def stats(self) -> Stats:
        raise NotImplementedError

    def throughput(self, *, since: str, bucket_s: int = 60) -> list[Throughput]:
        raise NotImplementedError

    def failures(self, *, limit: int = 20) -> list[FailureGroup]:
        raise NotImplementedError

    def matrix(self) -> list[MatrixCell]:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError
