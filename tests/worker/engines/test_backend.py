"""Warp as it is started: its default device, kernels compiled ahead, and where compiled ones are kept."""

import os
import sys
import threading
from pathlib import Path

import pytest

from graspd.service import user_cache
from graspd.worker.engines import backend
from graspd.worker.engines.backend import kernel_cache
from tests.conftest import PACKAGES, REPOSITORY
from tests.shell import completed
from tests.waiting import PATIENCE_S

MODULE = "graspd.worker.simulation.kernels.optimizers"
START = """
import importlib, warp as wp
from graspd.worker.engines import backend
backend.start_warp()
print(wp.config.kernel_cache_dir)
"""
LOAD = START + f"wp.load_module(importlib.import_module({MODULE!r}), device='cpu')"
BAKE = f"""
from graspd.worker.engines import backend
from tests.conftest import PACKAGES, REPOSITORY
backend.start_warp()
backend.compile_modules([{MODULE!r}], architectures=[90])
"""


def test_the_default_device_of_one_thread_is_not_that_of_another() -> None:
    backend.start_warp()
    from warp._src.context import runtime  # noqa: TID251 (what backend.py changes)

    first, seen, set_, looked = runtime.default_device, [], threading.Event(), threading.Event()

    def other() -> None:
        runtime.default_device = "a GPU"
        set_.set()
        looked.wait(PATIENCE_S)
        seen.append(runtime.default_device)

    thread = threading.Thread(target=other)
    thread.start()
    assert set_.wait(PATIENCE_S)
    assert runtime.default_device is first
    runtime.default_device = "the CPU"
    looked.set()
    thread.join()
    runtime.default_device = first
    assert seen == ["a GPU"]


def run(code: str, **places: str) -> str:
    done = completed([sys.executable, "-c", code], env={**os.environ, **places})
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    return done.stdout.strip()


def files(folder: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of every file by its path in the folder."""
    return {
        str(file.relative_to(folder)): (file.stat().st_ino, file.stat().st_mtime_ns)
        for file in folder.rglob("*")
        if file.is_file()
    }


@pytest.fixture(scope="module")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kernels")
    run(BAKE, WARP_CACHE_PATH=str(folder), GRASPD_KERNELS="")
    return folder


def test_binaries_for_gpus_are_made_without_one(kernels: Path) -> None:
    assert [file for file in kernels.rglob("*.sm90.cubin") if file.stat().st_size > 1000]


def test_a_fresh_cache_gets_them_and_nothing_is_compiled(kernels: Path, tmp_path: Path) -> None:
    places = {"WARP_CACHE_PATH": str(tmp_path / "cache"), "GRASPD_KERNELS": str(kernels)}
    laid_out = Path(run(START, **places))
    before = files(laid_out)
    assert before.keys() == files(kernels / laid_out.name).keys()
    run(LOAD, **places)
    assert files(laid_out) == before


def test_without_the_folder_kernels_are_compiled(kernels: Path, tmp_path: Path) -> None:
    cache = Path(run(LOAD, WARP_CACHE_PATH=str(tmp_path / "cache"), GRASPD_KERNELS=str(tmp_path / "none")))
    assert any(name.endswith(".o") for name in files(cache))


def test_a_cache_keeps_what_it_has(kernels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = next(file for file in kernels.rglob("*.o"))
    kept = tmp_path / source.parent.name / source.name
    kept.parent.mkdir()
    kept.write_bytes(b"ours")
    monkeypatch.setenv(backend.VARIABLE, str(kernels))
    backend.copy_compiled_kernels(tmp_path)
    assert len(files(tmp_path)) == len(files(kernels))
    assert kept.read_bytes() == b"ours"


def test_every_module_of_kernels_is_known() -> None:
    # Modules are found by their names: one with a kernel under another name would be compiled at first use.
    sources = [file for package in PACKAGES for file in (REPOSITORY / package).rglob("*.py")]
    having = {file for file in sources if "@wp.kernel" in file.read_text()}
    assert {file.stem for file in having} <= {part for name in backend.kernel_modules() for part in name.split(".")}
    assert len(having) == len(backend.kernel_modules())


@pytest.fixture
def blocked(tmp_path: Path) -> Path:
    """A folder that nobody can make, root neither: a file stands in its way."""
    (tmp_path / "file").write_text("")
    return tmp_path / "file" / "cache"


def test_kernels_go_where_warp_has_them_or_the_user_can_write(blocked: Path, tmp_path, monkeypatch, caplog) -> None:
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "kernels"))
    assert kernel_cache() is None
    monkeypatch.setenv("WARP_CACHE_PATH", str(blocked))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "mine"))
    assert kernel_cache() == tmp_path / "mine" / "graspd" / "warp" == user_cache.cache_folder("warp")
    assert str(blocked) in caplog.text


def test_warp_starts_where_the_user_can_write_nowhere(blocked: Path, tmp_path: Path) -> None:
    (tmp_path / "tmp").mkdir()
    at, free = str(blocked), str(tmp_path / "tmp")
    assert run(START, HOME=at, XDG_CACHE_HOME="", WARP_CACHE_PATH=at, TMPDIR=free).startswith(free)
