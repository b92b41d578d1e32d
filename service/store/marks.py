"""A mark that store and index share: where they differ, one of them was exchanged for an older copy."""

from __future__ import annotations

import secrets

from service.model import names
from service.model.clock import timestamp
from service.store.seals import put_document
from service.store.store import Store


def newest_mark(store: Store) -> str:
    """The mark of a store; empty where it has none yet."""
    return max((entry.key.rpartition("/")[2].removesuffix(".json") for entry in store.list(names.MARKS)), default="")


def next_mark(mark: str) -> str:
    """One that sorts behind a mark, and that no other store or index has."""
    number = int(mark.partition("-")[0] or 0) + 1
    return f"{number:012}-{secrets.token_hex(4)}"


def set_mark(store: Store, mark: str) -> None:
    """Give a store another mark."""
    put_document(store, names.mark(mark), {"at": timestamp()})
    for key in [entry.key for entry in store.list(names.MARKS)]:
        if key != names.mark(mark):
            store.delete(key)
