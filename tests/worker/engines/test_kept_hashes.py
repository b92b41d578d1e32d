"""Hashes of kernels that are kept are those that Warp finds, and none is kept of what has changed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import warp as wp
from warp._src import context

from service import user_cache
from worker.engines import backend, baked, kept_hashes
from worker.simulation.kernels import optimizers, penalties, solids, wrenches

pytestmark = pytest.mark.skipif(wp.config.version != backend.KNOWN_WARP, reason="it is for one release of Warp")
OPTIMIZERS = optimizers.__name__


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    backend.start()
    return tmp_path / "graspd" / "kernel_hashes"


def hashed(name: str, by: Any = kept_hashes.KeptHasher) -> Any:
    """A module's hasher, as a process that begins makes it."""
    module = context.user_modules[name]
    return by(module._get_live_kernels(), module.resolve_options(wp.config, block_dim=1))


def told(hasher: Any) -> tuple[Any, ...]:
    """All that Warp reads from a hasher."""
    kernels = {k.key: (h, k.hash, k.grid_stride, k.adj.kernel_dim, k.adj.tid_extent_limit_candidate)
               for k, h in hasher.kernel_hashes.items()}  # fmt: skip
    return hasher.get_hash(), kernels, [(h, k.key) for h, k in hasher.unique_kernels.items()]


def test_the_hash_of_every_module_is_that_of_warp_before_and_after_it_is_kept(own_cache: Path) -> None:
    names = baked.modules()
    assert len(names) > 20
    for name in names:
        import_module(name)
        expected = told(hashed(name, kept_hashes._WARPS))
        found, again = hashed(name), hashed(name)
        assert told(found) == told(again) == expected, name
        assert again._whole is False, f"{name} was hashed again"
    assert len(list(own_cache.iterdir())) == len(names)


def test_the_way_a_module_is_compiled_is_part_of_its_hash() -> None:
    module = context.user_modules[OPTIMIZERS]
    kernels = module._get_live_kernels()
    found = {
        dim: kept_hashes.KeptHasher(kernels, module.resolve_options(wp.config, block_dim=dim)).hash
        for dim in (1, 256, 1, 256)
    }
    assert found[1] != found[256]


@pytest.mark.parametrize(
    ("user", "place", "name", "other"),
    [
        (solids, solids, "LOOKS", 21),
        (penalties, penalties, "add_wrench", wrenches.clear_wrench),
        (penalties, wrenches, "MOST", 2.0e6),
    ],
    ids=["constant", "function", "constant of a function in another module"],
)
def test_what_a_name_stands_for_is_part_of_the_hash(
    user: ModuleType, place: ModuleType, name: str, other: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = told(hashed(user.__name__))
    monkeypatch.setattr(place, name, other)
    found = hashed(user.__name__)
    assert found._whole, "nothing was kept of that"
    assert told(found) == told(hashed(user.__name__, kept_hashes._WARPS)) != before


@pytest.mark.parametrize("content", [b"", b"{", b"{}", b'{"module": "00", "kernels": {}}', b"[1]"])
def test_an_entry_that_is_none_is_made_again(own_cache: Path, content: bytes) -> None:
    expected = told(hashed(OPTIMIZERS))
    (file,) = own_cache.iterdir()
    whole = file.read_bytes()
    user_cache.keep(file, content)
    assert told(hashed(OPTIMIZERS)) == expected and file.read_bytes() == whole
    file.write_bytes(whole[:-1])
    assert told(hashed(OPTIMIZERS)) == expected and file.read_bytes() == whole


def test_a_wrong_hash_is_found_out_before_anything_is_compiled_and_forgotten(own_cache: Path) -> None:
    expected = told(hashed(OPTIMIZERS))
    (file,) = own_cache.iterdir()
    content = json.loads(user_cache.load(file) or b"")
    user_cache.keep(file, json.dumps({**content, "module": "0" * 64}).encode())
    wrong = hashed(OPTIMIZERS)
    with pytest.raises(RuntimeError, match=OPTIMIZERS):
        wrong.get_unique_kernels()
    assert told(hashed(OPTIMIZERS)) == expected


def test_kernels_made_in_a_function_are_left_to_warp(own_cache: Path) -> None:
    scale = wp.constant(3.0)

    @wp.kernel(module="unique")
    def scaled(out: wp.array(dtype=float)) -> None:
        out[wp.tid()] = scale

    with wp.ScopedDevice("cpu"):
        out = wp.zeros(2)
        wp.launch(scaled, 2, outputs=[out])
    assert out.numpy().tolist() == [3.0, 3.0] and not own_cache.exists()


def test_modules_of_others_are_left_to_warp(own_cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Without a function in it nothing else would tell it from one of ours.
    (tmp_path / "others.py").write_text(
        "import warp as wp\n\n@wp.kernel\ndef one(out: wp.array(dtype=float)):\n    out[wp.tid()] = 1.0\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    import_module("others")
    hashed("others")
    assert hashed("others")._whole and not own_cache.exists()


LAUNCHED = f"""
from importlib import import_module
import warp as wp
from worker.engines import backend
backend.start()
from warp._src import context
module = import_module({OPTIMIZERS!r})
context.user_modules[{OPTIMIZERS!r}].load("cpu", block_dim=1)
hasher = context.user_modules[{OPTIMIZERS!r}].hashers[1]
print(hasher._whole, hasher.hash.hex(), len(context.user_modules[{OPTIMIZERS!r}].execs))
"""


@pytest.mark.slow
def test_what_is_not_compiled_yet_is_compiled_under_the_kept_hash(tmp_path: Path) -> None:
    def run(compiled: str) -> list[str]:
        environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / compiled), "GRASPD_KERNELS": ""}
        done = subprocess.run([sys.executable, "-c", LAUNCHED], env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    first, second, elsewhere = run("a"), run("a"), run("b")
    assert first[1:] == second[1:] == elsewhere[1:]
    assert [first[0], second[0], elsewhere[0]] == ["True", "False", "True"], "hashed, kept, kept and compiled"
