"""docs/how-to/robots.md: every command on it works as it stands."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from graspd.exchange.robot_export import ALIASES, FORMATS
from tests.conftest import REPOSITORY
from tests.exchange.robots.arms import write_arm
from tests.exchange.robots.shards import run

PAGE = (REPOSITORY / "docs" / "how-to" / "robots.md").read_text()


def commands() -> list[list[str]]:
    blocks = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    return [shlex.split(line, comments=True) for block in blocks for line in block.splitlines() if line.strip()]


@pytest.mark.slow
def test_every_command_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mink")
    pytest.importorskip("pxr")
    monkeypatch.chdir(tmp_path)
    write_arm(tmp_path).rename("arm.urdf")
    assert len(commands()) >= 12
    for program, *arguments in commands():
        if program == "python":
            subprocess.run([sys.executable, "-I", *arguments], check=True, capture_output=True)
            continue
        assert program == "graspd"
        found = run(*arguments)
        assert found.exit_code == 0, f"{arguments}: {found.output}"
        assert Path(arguments[arguments.index("-o") + 1]).exists()


def test_every_format_of_the_command_is_on_the_page() -> None:
    on_page = {line.partition("|")[2].partition("|")[0].strip(" `") for line in PAGE.splitlines()}
    assert set(FORMATS) <= on_page
    assert all(name in PAGE for name in ALIASES)
