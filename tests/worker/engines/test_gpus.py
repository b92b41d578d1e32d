"""Processes of one machine take different GPUs. The GPUs are made up: only their names and ids are asked for."""

import logging
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator

import pytest

from graspd.service.model.errors import InputError
from graspd.worker.engines import devices
from graspd.worker.engines.devices import Device, Gpu, take

FOUR = [Gpu(f"cuda:{k}", f"GPU-{k:04}", "H200") for k in range(4)]


@pytest.fixture(autouse=True)
def own_locks(tmp_path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Locks of this test alone; a lock that is taken twice here is as one of two processes."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(devices, "_held", [])
    yield
    for lock in devices._held:
        lock.close()


def test_each_process_takes_its_own_gpu_then_they_share_evenly(tmp_path) -> None:
    taken = [take(FOUR, tmp_path).name for _ in range(10)]
    assert taken[:4] == [gpu.name for gpu in FOUR]
    assert sorted(Counter(taken).values()) == [2, 2, 3, 3]
    # Names count what a process sees, as CUDA_VISIBLE_DEVICES has it; ids are the machine's.
    seen = [Gpu("cuda:0", "GPU-0001"), Gpu("cuda:1", "GPU-0002")]
    assert take(seen, tmp_path).id == "GPU-0002"


def test_the_gpu_of_a_killed_process_is_free_again(tmp_path) -> None:
    script = (
        "import sys, time, pathlib\n"
        "from graspd.worker.engines.devices import Gpu, take\n"
        "two = [Gpu('cuda:0', 'a'), Gpu('cuda:1', 'b')]\n"
        "print(take(two, pathlib.Path(sys.argv[1])).name, flush=True)\n"
        "time.sleep(600)\n"
    )
    two = [Gpu("cuda:0", "a"), Gpu("cuda:1", "b")]
    with subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline().strip() == "cuda:0"
        assert take(two, tmp_path).name == "cuda:1"
        other.kill()
        other.wait()
    assert take(two, tmp_path).name == "cuda:0"


def test_without_a_place_for_locks_it_is_the_first(tmp_path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("")
    with caplog.at_level(logging.WARNING):
        assert take(FOUR, tmp_path / "file" / "gpus").name == "cuda:0"
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
    with pytest.raises(InputError, match=r"no device 'cuda:1'; there are: cpu"):
        Device("cuda:1")
