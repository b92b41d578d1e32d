"""GPUs and kernels as the doctor sees them."""

import json
import signal
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from graspd.commands import doctor
from graspd.service.run.doctor.checks import Condition
from graspd.service.settings import Settings
from graspd.worker.process.selfcheck import EngineError

GIB = 2**30
H100 = {"name": "cuda:0", "model": "H100", "total": 80 * GIB, "free": 79 * GIB}


def says(**document: Any) -> Callable[[Sequence[str]], subprocess.CompletedProcess[str]]:
    return lambda arguments: subprocess.CompletedProcess([], 0, f"a line of a library\n{json.dumps(document)}\n", "")


def gpus(*found: dict[str, Any], driver: list[int] | None = None) -> Any:
    return says(gpus=list(found), driver=driver, toolkit=[13, 4])


@pytest.mark.parametrize(
    ("device", "there", "has_driver", "condition", "told"),
    [
        ("auto", [], False, Condition.GOOD, "none; work runs on the CPU"),
        ("auto", [H100], True, Condition.GOOD, "79 of 80 GiB free"),
        ("cuda:0", [H100], True, Condition.GOOD, "H100"),
        ("cuda:1", [H100], True, Condition.BAD, "there are cuda:0"),
        ("cuda:0", [], False, Condition.BAD, "no GPU is found"),
        ("auto", [], True, Condition.BAD, "has an NVIDIA driver"),
        ("auto", [{**H100, "free": GIB}], True, Condition.WARNING, "1 of 80 GiB free"),
    ],
)
def test_gpus_are_validated(
    tmp_path: Path, device: str, there: list[dict[str, Any]], has_driver: bool, condition: Condition, told: str
) -> None:
    settings = Settings(data_dir=tmp_path, device=device)
    found = doctor.check_gpu(settings, child=gpus(*there, driver=[12, 8]), has_driver=lambda: has_driver)
    assert found.condition is condition, found
    assert told in found.message
    assert bool(found.fix) is (condition is not Condition.GOOD)


def test_an_engine_that_gives_nonsense_is_bad_with_its_reason(tmp_path: Path) -> None:
    child = says(device="cpu (CPU)", error="scene: ArithmeticError: a ball floats", cache="/cache/warp")
    found = doctor.check_kernels(Settings(data_dir=tmp_path), child=child)
    assert not found.ok and "a ball floats" in found.message
    assert "/cache/warp" in found.fix


def test_a_driver_that_crashes_or_hangs_takes_only_the_child_with_it(tmp_path: Path) -> None:
    def crash(arguments: Sequence[str]) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess([], -signal.SIGSEGV, "", "")

    hang = Mock(side_effect=subprocess.TimeoutExpired([], 120.0))
    for look in (doctor.check_gpu, doctor.check_kernels):
        for child, told in ((crash, "signal 11"), (hang, "no answer within 120 s")):
            found = look(Settings(data_dir=tmp_path), child=child)
            assert not found.ok and told in found.message


def test_the_child_tells_what_this_machine_has_and_what_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    done = doctor.run_child(["gpus"])
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["toolkit"][0] >= 12
    broken = Mock(side_effect=EngineError("synthesize: OSError: no kernels"))
    monkeypatch.setattr("graspd.worker.process.selfcheck.check_engine", broken)
    told = doctor._report_kernels("cpu")
    assert told["error"] == "synthesize: OSError: no kernels" and told["device"].startswith("cpu (")
