"""Store, index and queue, which every process of graspd talks to, opened from the settings."""

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
    """Store, index and queue. Only API and controller open the index; a worker uses `open_store` and the queue."""

    settings: Settings
    store: Store
    index: Index
    queue: RqQueue

    @classmethod
    def open(cls, settings: Settings, *, patience: int = 3, make: bool = True, anew: bool = False) -> Self:
        """Open all three: makes the data folder and an index; does not need Redis to answer yet.

        Args:
            patience: how often Redis is tried before it counts as away.
            make: whether the folder of a store is made where it is absent.
            anew: whether an index of another revision is emptied; see `Database`.

        Raises:
            NotFoundError: there is no store, and none is to be made.
            StoreUnavailable, IndexUnavailable: where they cannot be opened.
        """
        from graspd.service.index.index import Index
        from graspd.service.queue.rq_queue import open_queue

        store = open_store(settings.resolved_store_url, public_endpoint=settings.store_public_endpoint, make=make)
        index = Index(settings.resolved_index_url, anew=anew)
        return cls(settings, store, index, open_queue(settings, patience=patience))

    def close(self) -> None:
        """Give all connections back."""
        self.index.close()
        self.queue.close()
