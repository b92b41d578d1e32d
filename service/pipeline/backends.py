"""Store, index and queue of a process, and transactions that write records and index rows together."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from pydantic import BaseModel

from graspd.service.model.errors import StoreUnavailable
from graspd.service.settings import Settings
from graspd.service.store.records import Put, put_record
from graspd.service.store.store import Store, open_store

if TYPE_CHECKING:
    from sqlalchemy import Connection

    from graspd.service.index.index import Index
    from graspd.service.queue.rq_queue import RqQueue

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Services:
    """Store, index and queue of the API and the controller; workers use only store and queue."""

    settings: Settings
    store: Store
    index: Index
    queue: RqQueue

    @classmethod
    def open(cls, settings: Settings, *, patience: int = 3, make: bool = True, anew: bool = False) -> Self:
        """Open store, index and queue; create the data folder and the index. Redis need not answer yet.

        `patience`: attempts per Redis command. Without `make`, NotFoundError for a missing store folder. `anew` empties
        an index of another revision.
        """
        from graspd.service.index.index import Index
        from graspd.service.queue.rq_queue import open_queue

        store = open_store(settings.resolved_store_url, public_endpoint=settings.store_public_endpoint, make=make)
        index = Index(settings.resolved_index_url, anew=anew)
        return cls(settings, store, index, open_queue(settings, patience=patience))

    def close(self) -> None:
        self.index.close()
        self.queue.close()


@contextmanager
def record_transaction(services: Services, made: Sequence[str] = ()) -> Iterator[tuple[Connection, Put]]:
    """Yield an index transaction and a function to store records; an error deletes them and keys `made`.

    No other process can write to the index during the transaction, so a check at its beginning still holds at its end.
    """
    keys = list(made)

    def put(key: str, record: BaseModel) -> bool:
        if is_new := put_record(services.store, key, record):
            keys.append(key)
        return is_new

    with services.index.database.write_transaction() as connection:
        try:
            yield connection, put
            services.index.notes.count_change(within=connection)
            connection.commit()
        except Exception:
            for key in keys:
                try:
                    services.store.delete(key)
                except StoreUnavailable as error:
                    log.error("%s remains in the store although its request failed: %s", key, error)
            raise
