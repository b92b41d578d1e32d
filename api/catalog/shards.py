"""Shards: the files that jobs make, and what their manifests say."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Literal

from graspd.api.access.auth import project_scope
from graspd.api.models import Shard
from graspd.service.index.views import Page, ShardView
from graspd.service.pipeline.backends import Services
from graspd.service.store.integrity import CheckedObjects


class Shards:
    """Shards of the jobs in the caller's scope; they never change."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._checked = CheckedObjects(services.store)

    def page(
        self,
        *,
        job: str | None = None,
        kind: Literal["base", "scene", "views"] | None = None,
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[Shard]:
        """Shards, all or those of a job."""
        page = self._services.index.shards.page(job=job, kind=kind, limit=limit, cursor=cursor, scope=project_scope())
        return Page[Shard](items=[_shard(shard) for shard in page.items], next=page.next)

    def one(self, shard_id: str) -> Shard:
        return _shard(self._services.index.shards.get(shard_id, scope=project_scope()))

    def intact(self, shard_id: str) -> Shard:
        """A shard whose file is what its checksum says; read through once, then again only where it was changed.

        Raises:
            DamagedShard: its file is gone, or has another checksum.
        """
        shard = self.one(shard_id)
        self._checked.check(shard.key, shard.sha256)
        return shard

    def address(self, shard: Shard) -> str | None:
        """Where the store itself hands the file out to a GET; None where it does not."""
        return self._services.store.sign(shard.key)

    def size(self, shard: Shard) -> int:
        """Bytes of the file as it lies in the store."""
        return self._services.store.size(shard.key)

    def stream(self, shard: Shard, start: int, length: int) -> Iterator[bytes]:
        """Bytes of the file, in chunks that are what they were when it was found intact.

        Raises:
            DamagedShard: they are not; from the iterator as well, which then ends before its end.
        """
        return self._checked.stream(shard.key, shard.sha256, start, length)

    def job_of(self, shard_id: str) -> str | None:
        """A job that a shard belongs to; None where it is gone."""
        return self._services.index.shards.job_of(shard_id, scope=project_scope())

    def assets_of(self, ids: Collection[str]) -> dict[str, tuple[str, str]]:
        """Digests of the hand and the object of each shard."""
        return self._services.index.shards.assets_of(ids)


def _shard(shard: ShardView) -> Shard:
    return Shard(**shard.model_dump(), file=f"/v1/shards/{shard.id}/file")
