"""Small shards made by the command line, once a session."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from graspd.cli import build

COMMON = ["--fidelity", "draft", "--want", "candidates", "--seed", "3", "--threads", "2"]
FREE = ["--hand", "barrett", "--object", "block", "-n", "6", *COMMON]
# Without a validator, so that not all of them lift.
TABLE = [
    *(
        "--hand",
        "barrett",
        "--object",
        "bottle",
        "--scene",
        "table",
        "--scenes",
        "2",
        "-n",
        "6",
        "--validation",
        "none",
    ),
    *COMMON,
]
PRESSING = [*TABLE, "--touch", "-1"]
CLUTTER = [*TABLE, "--with", "block"]


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(build(), [str(one) for one in arguments])


def make(arguments: list[str], file: Path) -> Path:
    found = run("synth", *arguments, "-o", file)
    assert found.exit_code == 0, found.output
    return file
