"""Warp as it is started, errors of GPUs, and processes of one machine that take different GPUs."""

import gc
import logging
import os
import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path

import pytest
import warp as wp

from graspd.service import user_cache
from graspd.service.model.errors import InputError
from graspd.worker.engines import backend, devices
from graspd.worker.engines.backend import kernel_cache
from graspd.worker.engines.devices import Device, DeviceLost, Gpu, check_device, is_out_of_memory, select_gpu
from graspd.worker.planners.threads import run_parts
from tests.conftest import PACKAGES, REPOSITORY
from tests.shell import completed
from tests.waiting import PATIENCE_S

#: As Warp 1.19 says it.
NO_MEMORY = "Failed to allocate 8589934592 bytes on device 'cuda:0'"
FOUR = [Gpu(f"cuda:{k}", f"GPU-{k:04}", "H200") for k in range(4)]


def test_only_a_gpu_without_memory_is_out_of_memory() -> None:
    assert is_out_of_memory(RuntimeError(NO_MEMORY))
    assert is_out_of_memory(RuntimeError("CUDA error 2 detected on device cuda:1: out of memory"))
    for said in (
        "Failed to allocate 64 bytes on device 'cpu'",
        "CUDA error 700 detected on device cuda:0",
        "error 201",
    ):
        assert not is_out_of_memory(RuntimeError(said))
    assert not is_out_of_memory(ValueError(NO_MEMORY))


@pytest.mark.parametrize(("code", "lost"), [(0, False), (2, False), (700, True), (719, True)])
def test_a_device_is_lost_by_any_error_but_want_of_memory(monkeypatch, code: int, lost: bool) -> None:
    def synchronize(device: str) -> None:
        if code:
            raise RuntimeError(f"Failed to synchronize device {device}: Warp CUDA error {code}: what happened")

    monkeypatch.setattr(wp, "synchronize_device", synchronize)
    check_device("cpu")
    if not lost:
        check_device("cuda:1")
        return
    with pytest.raises(DeviceLost, match=f"cuda:1: Warp CUDA error {code}"):
        check_device("cuda:1")


def work(room: int) -> tuple[list[range], object]:
    """Work that fits up to `room` grasps, and the launches that were tried."""
    tried: list[range] = []

    def launch(part: range) -> list[int]:
        tried.append(part)
        if len(part) > room:
            raise RuntimeError(NO_MEMORY)
        return list(part)

    return tried, launch


@pytest.mark.parametrize("room", [1, 3, 8, 31, 32])
def test_a_launch_that_does_not_fit_is_halved_until_it_does(room: int, caplog: pytest.LogCaptureFixture) -> None:
    gc.collect()
    gc.freeze()
    tried, launch = work(room)
    with caplog.at_level(logging.WARNING):
        found = run_parts([range(32)], launch)  # type: ignore[arg-type]
    assert [index for part in found for index in part] == list(range(32))
    assert len(caplog.messages) == len(tried) - len(found)
    assert room == 32 or caplog.messages[0].startswith("too little memory on the GPU for 32 grasps in one launch")


def test_one_grasp_without_room_and_other_errors_end_the_work() -> None:
    _, launch = work(0)
    with pytest.raises(RuntimeError, match="Failed to allocate"):
        run_parts([range(4)], launch)  # type: ignore[arg-type]
    tried = []

    def lost(part: range) -> None:
        tried.append(part)
        raise RuntimeError("CUDA error 700 detected on device cuda:0: an illegal memory access was encountered")

    with pytest.raises(RuntimeError, match="700"):
        run_parts([range(32)], lost)
    assert tried == [range(32)]


@pytest.fixture(autouse=True)
def own_locks(tmp_path, monkeypatch: pytest.MonkeyPatch):
    """Locks of this test alone; a lock that is taken twice here is as one of two processes."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(devices, "_held", [])
    yield
    for lock in devices._held:
        lock.close()


def test_each_process_takes_its_own_gpu_then_they_share_evenly(tmp_path) -> None:
    taken = [select_gpu(FOUR, tmp_path).name for _ in range(10)]
    assert taken[:4] == [gpu.name for gpu in FOUR]
    assert sorted(Counter(taken).values()) == [2, 2, 3, 3]
    # Names count what a process sees, as CUDA_VISIBLE_DEVICES has it; ids are the machine's.
    seen = [Gpu("cuda:0", "GPU-0001"), Gpu("cuda:1", "GPU-0002")]
    assert select_gpu(seen, tmp_path).id == "GPU-0002"


def test_the_gpu_of_a_killed_process_is_free_again(tmp_path) -> None:
    script = (
        "import sys, time, pathlib\n"
        "from graspd.worker.engines.devices import Gpu, select_gpu\n"
        "two = [Gpu('cuda:0', 'a'), Gpu('cuda:1', 'b')]\n"
        "print(select_gpu(two, pathlib.Path(sys.argv[1])).name, flush=True)\n"
        "time.sleep(600)\n"
    )
    two = [Gpu("cuda:0", "a"), Gpu("cuda:1", "b")]
    with subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline().strip() == "cuda:0"
        assert select_gpu(two, tmp_path).name == "cuda:1"
        other.kill()
        other.wait()
    assert select_gpu(two, tmp_path).name == "cuda:0"


def test_without_a_place_for_locks_it_is_the_first(tmp_path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("")
    with caplog.at_level(logging.WARNING):
        assert select_gpu(FOUR, tmp_path / "file" / "gpus").name == "cuda:0"
    assert "processes per GPU are not counted" in caplog.text


def test_a_number_decides_and_without_a_gpu_auto_is_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "visible_gpus", lambda: FOUR)
    assert [Device("auto").resolve() for _ in range(2)] == ["cuda:0", "cuda:1"]
    assert [Device("auto", number=number).resolve() for number in (3, 5)] == ["cuda:3", "cuda:1"]
    named = Device("cuda:2", number=0)
    assert (named.resolve(), named.name) == ("cuda:2", "H200")
    assert Device("auto").resolve() == "cuda:0", "each of the four was taken"
    monkeypatch.setattr(devices, "visible_gpus", list)
    assert Device("auto", number=1).resolve() == "cpu"
    for wanted, said in (("cuda:1", "no device 'cuda:1'; there are: cpu"), ("gpu", "use cpu, cuda:0")):
        with pytest.raises(InputError, match=said):
            Device(wanted)


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


def test_binaries_for_gpus_are_made_without_one_or_compiled(kernels: Path, tmp_path: Path) -> None:
    assert [file for file in kernels.rglob("*.sm90.cubin") if file.stat().st_size > 1000]
    cache = Path(run(LOAD, WARP_CACHE_PATH=str(tmp_path / "cache"), GRASPD_KERNELS=str(tmp_path / "none")))
    assert any(name.endswith(".o") for name in files(cache))


def test_a_fresh_cache_gets_them_and_nothing_is_compiled(kernels: Path, tmp_path: Path) -> None:
    places = {"WARP_CACHE_PATH": str(tmp_path / "cache"), "GRASPD_KERNELS": str(kernels)}
    laid_out = Path(run(START, **places))
    before = files(laid_out)
    assert before.keys() == files(kernels / laid_out.name).keys()
    run(LOAD, **places)
    assert files(laid_out) == before


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
