"""Sources of our kernels are parsed when somebody needs their syntax trees, which is to compile them.

Warp parses each kernel and function where it is declared, and walks through its tree for the modules that it refers to:
a fifteenth of the time until the first grasp. It needs the tree there for one thing only, to know that the lines it
took for a function's source are all of it. That follows from these lines and the function's name alone, so digests of
those that passed are kept on the machine. References tell Warp which modules to forget when one of them is imported
anew, which nobody does with ours.
"""

from __future__ import annotations

import ast
import atexit
import hashlib
import inspect
import json
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import warp as wp
from warp._src import context
from warp._src.codegen import Adjoint

from service import user_cache

#: Whose kernels these are.
_OURS: Final = "worker."
#: Digests that are kept; more than a few times as many as there are functions are those of old sources.
_MOST: Final = 4000
#: What Warp's constructor of an `Adjoint` sets last.
_LAST: Final = "_assignment_call_metadata"

_extracted: Final[Callable[[Any], tuple[str, int, Any]]] = Adjoint.extract_function_source
_references: Final[Callable[[Any, Any], None]] = context.Module._find_references


class _Late:
    """The tree of a source that is known to be a function's. While the function is declared it tells its name."""

    def __init__(self, source: str, name: str) -> None:
        self.body = (SimpleNamespace(name=name),)
        self._source = source
        self._tree: ast.Module | None = None

    def parsed(self) -> ast.Module:
        """The tree, the same one each time."""
        if self._tree is None:
            self._tree = ast.parse(self._source)
        return self._tree


class _Known:
    """Digests of sources that were parsed once and found to be those of functions."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._kept = _read(file)
        self._seen = dict[str, None]()
        self._new = False

    def knows(self, source: str, name: str) -> bool:
        digest = _digest(source, name)
        if digest in self._kept:
            self._seen[digest] = None
            return True
        return False

    def add(self, source: str, name: str) -> None:
        self._seen[_digest(source, name)] = None
        self._new = True

    def keep(self) -> None:
        """Write what is new, what was seen lately first."""
        if self._new:
            every = [*self._seen, *(digest for digest in _read(self._file) if digest not in self._seen)]
            user_cache.keep(self._file, json.dumps(every[:_MOST]).encode())
            self._new = False


def install() -> None:
    """Parse sources of ours late, from now on."""
    told = f"{wp.config.version} {sys.version}"
    known = _Known(user_cache.folder("kernel_sources") / f"{hashlib.sha256(told.encode()).hexdigest()[:32]}.json")
    atexit.register(known.keep)

    def extract(function: Any) -> tuple[str, int, Any]:
        return _extract(function, known)

    Adjoint.extract_function_source = staticmethod(extract)
    Adjoint.tree = property(_tree, _set_tree)
    context.Module._find_references = _find_references


def _extract(function: Any, known: _Known) -> tuple[str, int, Any]:
    """As Warp's own: dedented source, line of the file, tree."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    # What is computed where a kernel is declared needs its tree at once.
    if code is not None and function.__module__.startswith(_OURS):
        taken = Adjoint._try_extract_function_source(code)
        source = "" if taken is None else textwrap.dedent(taken[0])
        if taken is not None and "static" not in source:
            if known.knows(source, code.co_name):
                return source, taken[1], _Late(source, code.co_name)
            found = _extracted(function)
            if found[0] == source:
                known.add(source, code.co_name)
            return found
    return _extracted(function)


def _tree(adjoint: Any) -> Any:
    held = adjoint.__dict__["tree"]
    if isinstance(held, _Late) and _LAST in adjoint.__dict__:
        held = adjoint.__dict__["tree"] = held.parsed()
    return held


def _set_tree(adjoint: Any, tree: Any) -> None:
    adjoint.__dict__["tree"] = tree


def _find_references(module: Any, adjoint: Any) -> None:
    if not module.name.startswith(_OURS):
        _references(module, adjoint)


def _digest(source: str, name: str) -> str:
    return hashlib.sha256(f"{name}\0{source}".encode()).hexdigest()[:32]


def _read(file: Path) -> frozenset[str]:
    try:
        found = json.loads(user_cache.load(file) or b"[]")
    except ValueError:
        return frozenset()
    return frozenset(one for one in found if isinstance(one, str)) if isinstance(found, list) else frozenset()
