"""Ways in which a store loses what it was given."""

from typing import Any

import numpy as np
import obstore
from numpy.typing import NDArray

from graspd.service.store.store import Store


def overwrite(store: Store, key: str, data: bytes) -> None:
    obstore.put(store._backend, key, data, mode="overwrite")


def remove(store: Store, key: str) -> None:
    obstore.delete(store._backend, key)


def flip(store: Store, key: str) -> None:
    overwrite(store, key, flipped(store.get(key)))


def cut(store: Store, key: str) -> None:
    data = store.get(key)
    overwrite(store, key, data[: len(data) // 2])


def flipped(data: bytes, at: int | None = None) -> bytes:
    """Bytes with eight bits turned, by default in the middle."""
    at = len(data) // 2 if at is None else at
    return data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :]


def flipped_values(data: bytes, values: NDArray[Any]) -> bytes:
    """A shard's bytes with one of these values turned into another, as the file still opens."""
    at = data.index(np.ascontiguousarray(values).tobytes())
    return flipped(data, at + values.itemsize - 1)
