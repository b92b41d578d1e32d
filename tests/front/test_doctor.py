"""`graspd doctor`: exit codes, JSON, and what it says of a service that runs."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from graspd.doctor import all_checks
from graspd.service.settings import Settings
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
