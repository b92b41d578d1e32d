"""Identity of the service that owns a store, an index and a Redis.

Two services with a common store, index or Redis would undo each other's work. The store contains create-only records
with service ids, of which the last one applies; index and Redis repeat it. If both are empty, they count as another
service, until `graspd admin index rebuild` gives that service the store.
"""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import BusyError, QueueUnavailable
from graspd.service.model.records import Record
from graspd.service.store.records import put_record, read_record

if TYPE_CHECKING:
    from graspd.service.pipeline.backends import Services
    from graspd.service.store.store import Store

_FILE: Final = "service.id"
_BYTES: Final = 16
_REDIS: Final = (
    "this Redis belongs to another graspd service; give this one a Redis of its own, or another database number, in "
    "GRASPD_REDIS_URL; if the other is gone for good, empty this Redis: redis-cli FLUSHDB"
)


class ServiceRecord(Record):
    id: str
    at: str


@dataclass(frozen=True)
class ServiceIdentity:
    """Service ids in store (`chain`, the last one applies), index, Redis and data folder."""

    chain: Sequence[str]
    index: str | None = None
    redis: str | None = None
    folder: str | None = None
    is_own_store: bool = False

    @property
    def is_same(self) -> bool:
        """Whether the index (without an id there, Redis or the data folder) has the store's last id."""
        if self.index is not None:
            return self.index == self.chain[-1]
        others = {self.redis, self.folder} - {None}
        return self.chain[-1] in others or (self.is_own_store and not others)

    def refusal(self, store: str, *, take_over: bool = False) -> str:
        """Return why a process must not use these backends, in one line; "" if it may."""
        if self.redis is not None and self.redis not in (*self.chain, self.index):
            return _REDIS
        if not self.chain or self.is_same or take_over:
            return ""
        if self.index is not None and self.index not in self.chain:
            return _foreign_index_error(store)
        known = {self.index, self.redis, self.folder} & set(self.chain)
        what = "was taken over by" if known else "belongs to"
        return (
            f"the store {store} {what} another graspd service, with another index and Redis; give this one a store of "
            "its own, or if the other is gone for good, run `graspd admin index rebuild` here"
        )


def identify(
    services: Services,
    *,
    folder: Path | None = None,
    ask_redis: bool = True,
    take_over: bool = False,
    holds_redis: bool = False,
) -> str:
    """Check that store, index and Redis belong to one service; write its id where missing; return the id.

    `folder` is a data folder that also stores the id. `ask_redis` is False while Redis is not started. `take_over`
    gives the store to this service. `holds_redis`: this process has the controller's lease, so Redis belongs to it.
    BusyError: a backend belongs to another service.
    """
    # Redis is read first, so that concurrent new processes see each other's writes.
    redis = services.queue.service_id() if ask_redis else None
    left = recorded_service(folder)
    chain = service_ids(services.store)
    index = services.index.notes.service_id()
    if not chain:
        # An incomplete index may remain from a first start that was killed.
        if index is not None and not take_over and services.index.notes.completeness() is not None:
            raise BusyError(_foreign_index_error(services.store.url))
        index = services.index.notes.set_service_id(index or secrets.token_hex(_BYTES))
        if redis not in (None, index) and not holds_redis:
            raise BusyError(_REDIS)
        _add_service_record(services.store, 1, index)
        chain = service_ids(services.store)
    foreign = holds_redis and redis not in chain
    found = ServiceIdentity(chain, index, None if foreign else redis, left, services.settings.store_url is None)
    if why := found.refusal(services.store.url, take_over=take_over):
        raise BusyError(why)
    if take_over and not found.is_same:
        _add_service_record(services.store, len(chain) + 1, secrets.token_hex(_BYTES))
        chain = service_ids(services.store)
    mine = services.index.notes.set_service_id(chain[-1], instead=take_over)
    if ask_redis and redis != mine:
        services.queue.set_service_id(mine, instead=redis is not None)
        if not holds_redis and services.queue.service_id() not in chain:
            raise BusyError(_REDIS)
    if folder is not None and left != mine:
        (folder / _FILE).write_text(mine)
    return mine


def identify_if_redis_answers(services: Services, *, folder: Path | None = None, take_over: bool = False) -> str:
    try:
        return identify(services, folder=folder, take_over=take_over)
    except QueueUnavailable:
        return identify(services, folder=folder, take_over=take_over, ask_redis=False)


def check_service(store: Store, redis: str | None) -> bool:
    """Return whether Redis has a service id, given as `redis`; BusyError if it is not an id of the store."""
    if redis is not None and redis not in service_ids(store):
        raise BusyError(_REDIS)
    return redis is not None


def service_ids(store: Store) -> list[str]:
    return [read_record(ServiceRecord, store, key).id for key in store.keys(names.SERVICE)]


def recorded_service(folder: Path | None) -> str | None:
    """Return the id of the last service that ran in a data folder."""
    if folder is not None:
        with contextlib.suppress(OSError, UnicodeDecodeError):
            return (folder / _FILE).read_text().strip() or None
    return None


def _foreign_index_error(store: str) -> str:
    return (
        f"the index belongs to another graspd service than the store {store}; name the index of that store, or run "
        "`graspd admin index rebuild` to fill this one from the store"
    )


def _add_service_record(store: Store, number: int, identity: str) -> None:
    put_record(store, f"{names.SERVICE}/{number:06}.json", ServiceRecord(id=identity, at=timestamp()))
