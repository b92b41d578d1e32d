"""Shards: the files of jobs, and the content of their manifests."""

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
        """Return shards, all or those of a job."""
        page = self._services.index.shards.page(job=job, kind=kind, limit=limit, cursor=cursor, scope=project_scope())
        return Page[Shard](items=[_shard(shard) for shard in page.items], next=page.next)

    def one(self, shard_id: str) -> Shard:
        return _shard(self._services.index.shards.get(shard_id, scope=project_scope()))

    def intact(self, shard_id: str) -> Shard:
        """Return a shard whose file matches its checksum; a file is read again only after it changed.

        Raises:
            DamagedShard: its file is missing, or does not match its checksum.
        """
        shard = self.one(shard_id)
        self._checked.check(shard.key, shard.sha256)
        return shard

    def address(self, shard: Shard) -> str | None:
        """Return the address at which the store itself serves the file to GET; None if it does not."""
        return self._services.store.sign(shard.key)

    def size(self, shard: Shard) -> int:
        """Return the size of the file in the store [bytes]."""
        return self._services.store.size(shard.key)

    def stream(self, shard: Shard, start: int, length: int) -> Iterator[bytes]:
        """Yield bytes of the file in chunks, unchanged since the file was found intact.

        Raises:
            DamagedShard: they changed; raised by the iterator too, which then stops early.
        """
        return self._checked.stream(shard.key, shard.sha256, start, length)

    def job_of(self, shard_id: str) -> str | None:
        """Return a job that a shard belongs to; None if it is deleted."""
        return self._services.index.shards.job_of(shard_id, scope=project_scope())

    def assets_of(self, ids: Collection[str]) -> dict[str, tuple[str, str]]:
        """Return the digests of the hand and the object of each shard."""
        return self._services.index.shards.assets_of(ids)


def _shard(shard: ShardView) -> Shard:
    return Shard(**shard.model_dump(), file=f"/v1/shards/{shard.id}/file")
