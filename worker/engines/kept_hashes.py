"""Warp's hashes of its modules, kept on the machine.

Warp names a compiled module by a hash of its kernels. To find what they call it walks through their syntax trees in
every process, a twentieth of the time until the first grasp. Here the hash is kept under a digest of all that it can
follow from: sources and types of arguments of the kernels, and whatever the namespaces hold in which their names are
looked up. That is more than Warp looks at and quicker to tell, so what changes without need is hashed anew, and nothing
that changes is taken for what it was. Modules of others, and kernels made in functions, are left to Warp.
"""

from __future__ import annotations

import hashlib
import json
import platform
import sys
from collections.abc import Iterator, MutableMapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import warp as wp
from warp._src import context
from warp._src.codegen import Adjoint, Struct
from warp._src.types import get_type_code, is_value

from service import user_cache

#: Rooms whose kernels are kept, and from which they take constants and functions.
_OURS: Final = ("worker.", "service.")
#: All entries together; one has 1 kB.
_LIMIT_BYTES: Final = 16 << 20
_WARPS: Final[type[Any]] = context.ModuleHasher


def install() -> None:
    """Let Warp hash modules this way from now on."""
    context.ModuleHasher = KeptHasher


class KeptHasher(_WARPS):  # type: ignore[misc]
    """Warp's hasher of a module, with what an earlier process found where it is known."""

    hash: bytes
    kernel_hashes: MutableMapping[Any, bytes]
    unique_kernels: dict[bytes, Any]

    def __init__(self, kernels: Sequence[Any], options: dict[str, Any]) -> None:
        self._whole = True
        terms = _terms(kernels, options)
        if terms is None:
            super().__init__(kernels, options)
            return
        file = user_cache.folder("kernel_hashes") / f"{terms}.json"
        self._file = file
        if (found := _read(file, kernels)) is not None:
            self._restore(kernels, options, found)
            return
        super().__init__(kernels, options)
        content = {
            "module": self.hash.hex(),
            "kernels": {k.key: [self.kernel_hashes[k].hex(), k.grid_stride, k.adj.kernel_dim] for k in kernels},
        }
        user_cache.keep(file, json.dumps(content).encode(), limit_bytes=_LIMIT_BYTES)

    def _restore(self, kernels: Sequence[Any], options: dict[str, Any], found: dict[str, Any]) -> None:
        """Leave all as hashing leaves it, but for what is noted in functions: see `get_unique_kernels`."""
        super().__init__((), options)
        for kernel in kernels:
            digest, kernel.grid_stride, kernel.adj.kernel_dim = found["kernels"][kernel.key]
            kernel.adj.tid_extent_limit_candidate = context.warp._src.codegen._TID_MAX_EXTENT
            kernel.hash = bytes.fromhex(digest)
            self.kernel_hashes[kernel] = kernel.hash
            self.unique_kernels[kernel.hash] = kernel
        self.unique_kernels = dict(sorted(self.unique_kernels.items()))
        self.hash = bytes.fromhex(found["module"])
        self._whole, self._given = False, (tuple(kernels), options)

    def get_unique_kernels(self) -> Any:
        """Kernels to compile; Warp's compiler reads what its hasher noted in functions on its way."""
        if not self._whole:
            kept = self.hash
            super().__init__(*self._given)
            self._whole = True
            if self.hash != kept:
                # Files are named by the other hash already. The next process finds no entry, and hashes.
                self._file.unlink(missing_ok=True)
                raise RuntimeError(f"the kept hash of the kernels in {self._given[0][0].func.__module__} was another's")
        return super().get_unique_kernels()


def _read(file: Path, kernels: Sequence[Any]) -> dict[str, Any] | None:
    """What is kept of these kernels; None where nothing is, or it is not of them."""
    if (content := user_cache.load(file)) is None:
        return None
    try:
        found: dict[str, Any] = json.loads(content)
        sound = len(bytes.fromhex(found["module"])) == hashlib.sha256().digest_size
        for kernel in kernels:
            digest, stride, dimensions = found["kernels"][kernel.key]
            sound &= len(bytes.fromhex(digest)) == hashlib.sha256().digest_size
            sound &= isinstance(stride, bool) and isinstance(dimensions, int)
    except (ValueError, KeyError, TypeError):
        return None
    return found if sound and len(found["kernels"]) == len(kernels) else None


class _CannotTell(Exception):
    """Something of a kernel is not told by what is looked at here."""


def _terms(kernels: Sequence[Any], options: dict[str, Any]) -> str | None:
    """Digest of all that the hash of a module with these kernels follows from; None where that is not known."""
    if not kernels or len({kernel.key for kernel in kernels}) < len(kernels):
        return None
    whole = hashlib.sha256()
    try:
        for part in _told(kernels, options):
            whole.update(len(part).to_bytes(8, "little"))
            whole.update(part)
    except _CannotTell:
        return None
    return whole.hexdigest()[:32]


def _told(kernels: Sequence[Any], options: dict[str, Any]) -> Iterator[bytes]:
    yield f"{wp.config.version} {sys.version} {platform.machine()}".encode()
    for name in sorted(options):
        yield f"{name}:{options[name]}".encode()
    places = dict[str, None]()
    for kernel in sorted(kernels, key=lambda kernel: str(kernel.key)):
        ours = kernel.func.__module__.startswith(_OURS)
        if not ours or kernel.is_generic or kernel.return_annotation is not None:
            raise _CannotTell
        yield f"{kernel.key} {sorted(kernel.options.items())}".encode()
        yield from _adjoint(kernel.adj)
        places[kernel.func.__module__] = None
    # The namespaces of what kernels call come behind those of the kernels, until none is new.
    seen = list(places)
    for name in seen:
        yield name.encode()
        yield from _namespace(sys.modules[name], places)
        seen += [new for new in places if new not in seen]


def _namespace(module: ModuleType, places: dict[str, None]) -> Iterator[bytes]:
    """What names in the source of a kernel can stand for; adds modules in which further names are looked up."""
    for name, value in sorted(vars(module).items()):
        if isinstance(value, context.Function):
            if not value.is_builtin():
                yield name.encode()
                yield from _function(value, places)
        elif isinstance(value, Struct):
            yield f"{name} {value.key}".encode() + value.hash
        elif isinstance(value, ModuleType):
            if value.__name__.startswith(_OURS):
                yield f"{name} {value.__name__}".encode()
                places[value.__name__] = None
        elif isinstance(value, type):
            yield f"{name} {_code(value)}".encode()
            if value.__module__.startswith(_OURS):
                for key, held in sorted(vars(value).items()):
                    yield from _constant(f"{name}.{key}", held)
        else:
            yield from _constant(name, value)


def _function(function: Any, places: dict[str, None]) -> Iterator[bytes]:
    for signature, overload in sorted({**function.user_overloads, **function.user_templates}.items()):
        if overload.generic_parent is not None:
            continue  # made of another one, in a process that compiled it
        snippets = (overload.native_snippet, overload.adj_native_snippet, overload.replay_snippet)
        if overload.custom_grad_func or overload.custom_replay_func or any(snippets):
            raise _CannotTell
        yield f"{function.key} {signature} {overload.inline_hint}".encode()
        yield from _adjoint(overload.adj)
        if not overload.func.__module__.startswith(_OURS):
            raise _CannotTell
        places[overload.func.__module__] = None


def _adjoint(adjoint: Adjoint) -> Iterator[bytes]:
    """Source and types of the arguments of a kernel or function."""
    if (
        adjoint.func.__closure__
        or adjoint.transformers
        or adjoint.resolved_static_expressions
        or adjoint.has_unresolved_static_expressions
        or getattr(adjoint, "callable_arg_values", None)
    ):
        raise _CannotTell
    yield adjoint.source.encode()
    for name, kind in adjoint.arg_types.items():
        of = kind if isinstance(kind, Struct) else getattr(kind, "dtype", None)
        yield f"{name}:{get_type_code(kind)}".encode() + (of.hash if isinstance(of, Struct) else b"")


def _constant(name: str, value: Any) -> Iterator[bytes]:
    if is_value(value):
        yield f"{name} {type(value).__name__}".encode() + _WARPS.get_constant_bytes(None, value)


def _code(kind: type) -> str:
    """Warp's code of a type, such as a vector of eight; the name of any other."""
    try:
        return str(get_type_code(kind))
    except TypeError:
        return kind.__name__
