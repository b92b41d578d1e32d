"""What a GPU's errors mean for the work at hand; the errors are put in where Warp would tell them."""

import gc
import logging

import pytest
import warp as wp

from graspd.worker.engines.devices import DeviceLost, check_device, is_out_of_memory
from graspd.worker.planners.threads import run_parts

#: As Warp 1.19 says it.
NO_MEMORY = "Failed to allocate 8589934592 bytes on device 'cuda:0'"


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
def test_a_device_is_lost_by_any_error_but_want_of_memory(
    monkeypatch: pytest.MonkeyPatch, code: int, lost: bool
) -> None:
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


@pytest.fixture
def few_objects() -> None:
    """Each halving looks for garbage: among those objects alone that the test makes."""
    gc.collect()
    gc.freeze()


@pytest.mark.usefixtures("few_objects")
@pytest.mark.parametrize("room", [1, 3, 8, 31, 32])
def test_a_launch_that_does_not_fit_is_halved_until_it_does(room: int, caplog: pytest.LogCaptureFixture) -> None:
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
