"""Store, index and queue of a process, opened from the settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from graspd.service.settings import Settings
from graspd.service.store.store import Store, open_store

if TYPE_CHECKING:
    from graspd.service.index.index import Index
    from graspd.service.queue.rq_queue import RqQueue


@dataclass(frozen=True)
class Services:
    """Store, index and queue. Only API and controller open the index; workers use `open_store` and the queue."""

    settings: Settings
    store: Store
    index: Index
    queue: RqQueue

    @classmethod
    def open(cls, settings: Settings, *, patience: int = 3, make: bool = True, anew: bool = False) -> Self:
        """Open all three; create the data folder and the index. Redis need not answer yet.

        `patience` is the number of attempts to reach Redis. `make` creates a missing store folder (else NotFoundError);
        `anew` empties an index of another revision.
        """
        from graspd.service.index.index import Index
        from graspd.service.queue.rq_queue import open_queue

        store = open_store(settings.resolved_store_url, public_endpoint=settings.store_public_endpoint, make=make)
        index = Index(settings.resolved_index_url, anew=anew)
        return cls(settings, store, index, open_queue(settings, patience=patience))

    def close(self) -> None:
        self.index.close()
        self.queue.close()
