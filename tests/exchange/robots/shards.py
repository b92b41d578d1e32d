"""Small shards made by the command line, once a session."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from graspd.cli import build

COMMON = "--fidelity draft --want candidates --seed 3 --threads 2"
FREE = f"--hand barrett --object block -n 6 {COMMON}"
# Without a validator, so that not all of them lift.
TABLE = f"--hand barrett --object bottle --scene table --scenes 2 -n 6 --validation none {COMMON}"
PRESSING, CLUTTER = f"{TABLE} --touch -1", f"{TABLE} --with block"


def run(words: str, *more: Any) -> Result:
    """A command; `words` are cut at spaces, `more` are whole arguments."""
    return CliRunner().invoke(build(), [*words.split(), *(str(one) for one in more)])


def make(words: str, file: Path, *more: Any) -> Path:
    found = run(f"synth {words} -o", file, *more)
    assert found.exit_code == 0, found.output
    return file
