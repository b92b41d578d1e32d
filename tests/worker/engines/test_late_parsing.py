"""Kernels whose sources are parsed late are those that Warp would have: source, tree, and what is compiled."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
import warp as wp
from warp._src import context
from warp._src.codegen import Adjoint

from service import user_cache
from worker.engines import backend, baked, late_parsing

pytestmark = pytest.mark.skipif(wp.config.version != backend.KNOWN_WARP, reason="it is for one release of Warp")
MODULE = "worker.simulation.kernels.penalties"
DECLARED = f"""
import ast, sys
from worker.engines import backend
backend.start()
parsed, parse = [], ast.parse
ast.parse = lambda *given, **named: parsed.append(given) or parse(*given, **named)
from importlib import import_module
import warp as wp
module = import_module({MODULE!r})
declared = len(parsed)
if sys.argv[1:]:
    wp.load_module(module, device="cpu")
print(declared, len(parsed))
"""


def declared(home: Path, *, compiled: Path | None = None) -> tuple[int, int]:
    """Sources that a process parses where it declares kernels, and when it has compiled them into an empty folder."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(home), "GRASPD_KERNELS": ""}
    if compiled is not None:
        environment["WARP_CACHE_PATH"] = str(compiled)
    done = subprocess.run(
        [sys.executable, "-c", DECLARED, *(["load"] if compiled else [])], env=environment, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, second = map(int, done.stdout.split())
    return first, second


def test_sources_and_trees_of_all_kernels_are_those_of_warp() -> None:
    backend.start()
    count = 0
    for name in baked.modules():
        import_module(name)
        module = context.user_modules[name]
        functions = [one for function in module.functions.values() for one in function.user_overloads.values()]
        for one in [*module.kernels.values(), *functions]:
            source, line, tree = late_parsing._extracted(one.adj.func)
            assert (one.adj.source, one.adj.fun_lineno) == (source, line)
            assert ast.dump(one.adj.tree) == ast.dump(tree) and one.adj.tree is one.adj.tree
            count += 1
    assert count > 200


@pytest.mark.slow
def test_a_later_process_parses_nothing_until_it_compiles_and_compiles_the_same(tmp_path: Path) -> None:
    first, of_all = declared(tmp_path / "home", compiled=tmp_path / "first")
    assert 0 < first <= of_all
    assert declared(tmp_path / "home") == (0, 0)
    none, late = declared(tmp_path / "home", compiled=tmp_path / "second")
    assert none == 0 < late
    made = [
        {file.name: file.read_bytes() for file in (tmp_path / folder).glob("*/*/*") if file.suffix in (".cpp", ".meta")}
        for folder in ("first", "second")
    ]
    assert len(made[0]) > 1 and made[0] == made[1]


@pytest.mark.parametrize("content", [b"", b"{", b"{}", b"[1, null]", b'"text"', None])
def test_what_is_kept_of_sources_may_be_damaged(tmp_path: Path, content: bytes | None) -> None:
    first, _ = declared(tmp_path)
    (file,) = (tmp_path / "graspd" / "kernel_sources").iterdir()
    if content is None:
        file.write_bytes(file.read_bytes()[:-1])
    else:
        user_cache.keep(file, content)
    assert declared(tmp_path)[0] == first
    assert declared(tmp_path)[0] == 0
    assert len(json.loads(user_cache.load(file) or b"")) >= first


ODD = '''
def plain(x: float):
    return x

def odd(x: float):
    return """
not where a body ends"""

def fixed(x: float):
    return static(x)
'''


def known(tmp_path: Path) -> Any:
    return late_parsing._Known(tmp_path / "sources.json")


def test_lines_that_are_not_all_of_a_function_are_never_known(tmp_path: Path) -> None:
    (tmp_path / "odd.py").write_text(ODD)
    spec = spec_from_file_location("worker.odd", tmp_path / "odd.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    for _ in range(2):
        sources = known(tmp_path)
        for name in ("plain", "odd", "fixed"):
            source, line, tree = late_parsing._extract(getattr(module, name), sources)
            expected = late_parsing._extracted(getattr(module, name))
            assert (source, line) == expected[:2] and tree.body[0].name == name
            parsed = tree.parsed() if isinstance(tree, late_parsing._Late) else tree
            assert ast.dump(parsed) == ast.dump(expected[2])
        sources.keep()
        assert len(late_parsing._read(tmp_path / "sources.json")) == 1, "the plain one"


def test_functions_of_others_are_parsed_as_ever(tmp_path: Path) -> None:
    def mine(x: float) -> float:
        return x

    sources = known(tmp_path)
    for _ in range(2):
        assert isinstance(late_parsing._extract(mine, sources)[2], ast.Module)
    sources.keep()
    assert not (tmp_path / "sources.json").exists()


def test_an_adjoint_has_its_tree_once_it_is_made(tmp_path: Path) -> None:
    backend.start()

    def twice(x: float) -> float:
        return 2.0 * x

    source, _, tree = late_parsing._extracted(twice)
    adjoint = Adjoint(twice)
    adjoint.tree = late_parsing._Late(source, "twice")
    assert isinstance(adjoint.tree, ast.Module) and ast.dump(adjoint.tree) == ast.dump(tree)
    assert adjoint.tree is adjoint.tree
