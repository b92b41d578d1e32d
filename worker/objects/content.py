"""What a model holds, as a key for caches: of one file there are as many models as there are ways to prepare it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np

#: How a model is called says nothing of what it is.
_NAMES: Final = frozenset({"name", "digest"})
#: Metadata of a field that says nothing while it has its default.
TOLD_IF_SET: Final = MappingProxyType({"told_if_set": True})


def content_of(model: Any) -> str:
    """Digest of all fields of a dataclass but its name and the digest of its files: arrays bit for bit.

    Raises:
        TypeError: a field that holds neither numbers, texts, arrays, tuples and sets of these, nor a dataclass.
    """
    whole = hashlib.sha256()
    for part in _parts({name: value for name, value in _told(model).items() if name not in _NAMES}):
        whole.update(len(part).to_bytes(8, "little"))
        whole.update(part)
    return whole.hexdigest()[:32]


def _told(model: Any) -> dict[str, Any]:
    """Fields of a dataclass that say something."""
    values = {f: getattr(model, f.name) for f in fields(model)}
    return {
        f.name: value
        for f, value in values.items()
        if not (f.metadata.get("told_if_set") and type(value) is type(f.default) and value == f.default)
    }


def _parts(value: Any) -> Iterator[bytes]:
    if isinstance(value, np.ndarray):
        yield f"{value.dtype.str}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, dict):
        for key, held in value.items():
            yield str(key).encode()
            yield from _parts(held)
    elif isinstance(value, (tuple, frozenset)):
        yield f"{type(value).__name__}{len(value)}".encode()
        for held in sorted(value) if isinstance(value, frozenset) else value:
            yield from _parts(held)
    elif is_dataclass(value) and isinstance(told := getattr(value, "content", None), str):
        yield told.encode()
    elif is_dataclass(value) and not isinstance(value, type):
        yield from _parts(_told(value))
    elif isinstance(value, (str, int, float, np.generic)) or value is None:
        yield f"{type(value).__name__}{value!r}".encode()
    else:
        raise TypeError(f"a model cannot be told by a {type(value).__name__}")
