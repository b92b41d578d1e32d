"""`graspd doctor`: exit codes, JSON, GPUs and kernels, and what it says of a service that runs."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from graspd.commands import doctor
from graspd.doctor import all_checks
from graspd.service.run.doctor.checks import Condition
from graspd.service.settings import Settings
from graspd.worker.process.selfcheck import EngineError
from tests.conftest import REPOSITORY
from tests.servers import free_ports
from tests.shell import completed

QUICK = "disk,data-folder,limits,redis,store,index,port,keys"


def run(*arguments: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return completed(
        [sys.executable, "-m", "graspd", "doctor", *arguments],
        timeout=120,
        env={**os.environ, "GRASPD_DATA_DIR": str(folder), "GRASPD_PORT": str(free_ports(1)[0]), **environment},
    )


def test_a_fresh_machine_is_well_and_nothing_is_made_on_it(tmp_path: Path) -> None:
    done = run("--only", QUICK, "--json", folder=tmp_path / "data")
    assert done.returncode == 0, done.stdout + done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["ok"] is True
    assert [one["name"] for one in told["checks"]] == QUICK.split(",")
    assert all({"name", "ok", "message", "fix"} <= one.keys() for one in told["checks"])
    assert list(tmp_path.iterdir()) == []


def test_what_is_wrong_ends_it_with_1_and_says_the_mend(tmp_path: Path) -> None:
    away = f"redis://:hidden@127.0.0.1:{free_ports(1)[0]}/0"
    done = run("--only", "redis,keys", folder=tmp_path, GRASPD_REDIS_URL=away, GRASPD_HOST="0.0.0.0")
    assert done.returncode == 1
    lines = [line.split(maxsplit=2) for line in done.stdout.splitlines()]
    assert [line[:2] for line in lines if line[0] == "bad"] == [["bad", "redis"], ["bad", "keys"]]
    assert sum(line[0] == "fix:" for line in lines) == 2
    assert "hidden" not in done.stdout + done.stderr


@pytest.mark.parametrize("check", [check.name for check in all_checks(Settings())])
def test_operations_tells_every_check(check: str) -> None:
    assert f"| `{check}` |" in (REPOSITORY / "docs" / "how-to" / "operations.md").read_text()


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
