"""What cannot be understood on the command line is one line, with the word that was meant; and completion."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from graspd.cli import build

NOBODY = {"GRASPD_API_URL": "http://127.0.0.1:9"}


@pytest.mark.parametrize(
    ("command", "line"),
    [
        ("store verify", "no such command store; did you mean restore?"),
        ("admin stor", "no such command stor; did you mean store?"),
        ("jbos", "no such command jbos; did you mean jobs?"),
        ("datasets lst", "no such command lst; did you mean list?"),
        ("submit --handd allegro", "there is no option --handd; did you mean --hand?"),
        ("submit", "missing option --hand; see `graspd submit --help`"),
        ("submit --hand", "option --hand requires an argument"),
        ("submit --hand allegro --object mug -n 0", "--grasps: must be at least 1"),
        (
            "submit --hand allegro --object mug --grasps many",
            "--grasps: must be a whole number; see `graspd submit --help`",
        ),
        (
            "jobs --state runing",  # codespell:ignore runing
            "--state: must be one of queued, running, succeeded, failed, cancelled; did you mean running?",
        ),
        ("export x.h5 --format mjcf -o out", "there is no export format 'mjcf'"),
    ],
)
def test_a_mistake_is_one_line(command: str, line: str) -> None:
    done = CliRunner().invoke(build(), command.split(), prog_name="graspd", env=NOBODY)
    assert done.exit_code == 2
    assert done.stderr.startswith(f"graspd: {line}") and done.stderr.count("\n") == 1


GROUPS = ["Make grasps", "Use grasps", "Service", "Administration"]


def test_the_overview_has_four_groups() -> None:
    shown = CliRunner().invoke(build(), ["--help"], prog_name="graspd").stdout
    assert re.findall(r"─ ([A-Z][a-z ]+) ─", shown) == ["Options", *GROUPS]


def test_a_group_without_a_command_shows_its_help() -> None:
    done = CliRunner().invoke(build(), ["tags"], prog_name="graspd")
    assert done.exit_code == 2 and not done.stderr
    assert "Usage: graspd tags" in done.stdout


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    start = f"import sys; sys.argv[0] = 'graspd'; from graspd.cli import main\n{code}"
    return subprocess.run(
        [sys.executable, "-c", start], env=os.environ | environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("", "synth"),
        ("admin ker", "kernels"),
        ("admin index re", "rebuild"),
        ("datasets cr", "create"),
        ("export --for", "--format"),
        ("datasets card --li", "--licence"),
    ],
)
def test_completion_knows_commands_without_the_engine(typed: str, offered: str) -> None:
    code = "try: main()\nfinally: print('warp' in sys.modules, file=sys.stderr)"
    words = f"graspd {typed}"
    done = python(code, _GRASPD_COMPLETE="complete_bash", COMP_WORDS=words, COMP_CWORD=str(words.count(" ")))
    assert offered in done.stdout.split()
    assert done.stderr.strip() == "False"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_can_be_installed(shell: str, tmp_path: Path) -> None:
    # Without it typer would look at the processes above for the shell.
    names = {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1", "HOME": str(tmp_path)}
    done = python(f"sys.argv[1:] = ['--install-completion', '{shell}']; main()", **names)
    written = "".join(path.read_text() for path in tmp_path.rglob("*graspd*"))
    assert f"_GRASPD_COMPLETE=complete_{shell}" in written, done.stderr
