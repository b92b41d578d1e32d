"""Disk cache of arrays that are expensive to compute from a few inputs, and digests of models as keys."""

import hashlib
import io
import platform
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service import user_cache
from graspd.service.model.digests import digest_json
from graspd.service.model.libraries import version_of

#: Libraries that affect the arrays.
_LIBRARIES: Final = ("numpy", "scipy")
#: Size limit of all entries of a kind [bytes]; an entry has about 100 kB.
_LIMIT_BYTES: Final = 256 << 20

Arrays = Mapping[str, NDArray[Any]]
_recalled: ContextVar[dict[str, NDArray[Any]] | None] = ContextVar("recalled", default=None)


def cached_arrays(
    kind: str,
    terms: tuple[str | int, ...],
    code: tuple[ModuleType, ...],
    make: Callable[[], Arrays],
    *,
    fits: Callable[[Arrays], bool] = lambda _: True,
) -> Arrays:
    """Load arrays from a folder of the user's cache, or compute and cache them; both give the same bits.
    `terms` and the modules `code` must contain everything that determines the arrays. Errors of `make` are not cached.
    Loaded arrays for which `fits` returns False are recomputed."""
    file = _cache_file(kind, terms, code)
    if (held := _read(file)) is not None and fits(held):
        return held
    made = make()
    _write(file, made)
    return made


@contextmanager
def caching_steps(kind: str, terms: tuple[str | int, ...], code: tuple[ModuleType, ...]) -> Iterator[None]:
    """Cache the results of `cached_step` inside this context in one entry, and load them the next time.
    Only small steps that need a slowly loading library gain by this. The terms only distinguish entries."""
    file = _cache_file(kind, terms, code)
    known = _read(file) or {}
    now = dict(known)
    token = _recalled.set(now)
    try:
        yield
    finally:
        _recalled.reset(token)
    if len(now) > len(known):
        _write(file, now)


def cached_step(what: str, given: Sequence[NDArray[Any]], make: Callable[[], Sequence[NDArray[Any]]]) -> Arrays:
    """Return arrays "0", "1", ... that depend only on `given`; inside `caching_steps` they are cached."""
    known = _recalled.get()
    if known is None:
        return {str(number): array for number, array in enumerate(make())}
    whole = hashlib.sha256(what.encode())
    for array in given:
        whole.update(f"{array.dtype.str}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    key = f"{whole.hexdigest()[:32]}-"
    if key + "0" not in known:
        known |= {f"{key}{number}": array for number, array in enumerate(make())}
    found: dict[str, NDArray[Any]] = {}
    while (name := f"{key}{len(found)}") in known:
        found[str(len(found))] = known[name].copy()
    return found


def _cache_file(kind: str, terms: tuple[str | int, ...], code: tuple[ModuleType, ...]) -> Path:
    address = digest_json([*terms, code_revision(tuple(str(module.__file__) for module in code), _LIBRARIES)])
    return user_cache.cache_folder(kind) / f"{address}.npz"


def _read(file: Path) -> dict[str, NDArray[Any]] | None:
    if (held := user_cache.load(file)) is None:
        return None
    try:
        with np.load(io.BytesIO(held), allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile):
        return None


def _write(file: Path, arrays: Arrays) -> None:
    whole = io.BytesIO()
    np.savez(whole, **dict[str, Any](arrays))
    user_cache.store(file, whole.getvalue(), limit_bytes=_LIMIT_BYTES)


@lru_cache(maxsize=16)
def code_revision(files: tuple[str, ...], libraries: tuple[str, ...]) -> str:
    """Compute a digest of source files, libraries, and the processor type, which may affect the last bits."""
    whole = hashlib.sha256(b"".join(Path(file).read_bytes() for file in files))
    return digest_json([whole.hexdigest(), *map(version_of, libraries), platform.machine()])


#: A model's name does not affect its content.
_NAMES: Final = frozenset({"name", "digest"})
#: Metadata of a field that `content_digest` ignores while it has its default.
TOLD_IF_SET: Final = MappingProxyType({"told_if_set": True})
#: Metadata of a field that `content_of` ignores.
NOT_CONTENT: Final = MappingProxyType({"not_content": True})


def content_digest(model: Any) -> str:
    """Compute a digest of a dataclass without its name and its files' digest; arrays count bit for bit.
    Raises TypeError: a field is no number, string, array, tuple or set of these, nor a dataclass."""
    whole = hashlib.sha256()
    for part in _digest_parts({name: value for name, value in _digest_fields(model).items() if name not in _NAMES}):
        whole.update(len(part).to_bytes(8, "little"))
        whole.update(part)
    return whole.hexdigest()[:32]


def _digest_fields(model: Any) -> dict[str, Any]:
    """Return the fields of a dataclass that affect its digest."""
    values = {f: getattr(model, f.name) for f in fields(model) if not f.metadata.get("not_content")}
    return {
        f.name: value
        for f, value in values.items()
        if not (f.metadata.get("told_if_set") and type(value) is type(f.default) and value == f.default)
    }


def _digest_parts(value: Any) -> Iterator[bytes]:
    if isinstance(value, np.ndarray):
        yield f"{value.dtype.str}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, dict):
        for key, held in value.items():
            yield str(key).encode()
            yield from _digest_parts(held)
    elif isinstance(value, (tuple, frozenset)):
        yield f"{type(value).__name__}{len(value)}".encode()
        for held in sorted(value) if isinstance(value, frozenset) else value:
            yield from _digest_parts(held)
    elif is_dataclass(value) and isinstance(digest := getattr(value, "content", None), str):
        yield digest.encode()
    elif is_dataclass(value) and not isinstance(value, type):
        yield from _digest_parts(_digest_fields(value))
    elif isinstance(value, (str, int, float, np.generic)) or value is None:
        yield f"{type(value).__name__}{value!r}".encode()
    else:
        raise TypeError(f"a model with a {type(value).__name__} has no digest")
