"""Records and rows in one step: the records of one write transaction of the index appear together."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from pydantic import BaseModel
from sqlalchemy import Connection

from graspd.service.model.errors import StoreUnavailable
from graspd.service.pipeline.backends import Services
from graspd.service.store.records import Put, put_record

log = logging.getLogger(__name__)


@contextmanager
def recording(services: Services, made: Sequence[str] = ()) -> Iterator[tuple[Connection, Put]]:
    """Yield a write transaction of the index and a function that puts records; a failure deletes them and `made`.

    No other process writes meanwhile: checks before the records still hold at the write of the rows.
    """
    keys = list(made)

    def put(key: str, record: BaseModel) -> bool:
        is_new = put_record(services.store, key, record)
        keys.extend([key] if is_new else [])
        return is_new

    with services.index.database.writing() as connection:
        try:
            yield connection, put
            services.index.notes.count_change(within=connection)
            connection.commit()
        except Exception:
            for key in keys:
                try:
                    services.store.delete(key)
                except StoreUnavailable as error:
                    log.error("%s stays in the store though its request was refused: %s", key, error)
            raise
