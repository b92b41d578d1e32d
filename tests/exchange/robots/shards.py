"""Small shards made by the command line, once a session."""

from __future__ import annotations

from pathlib import Path

from tests.worker.commands_run import graspd

COMMON = "--fidelity draft --want candidates --seed 3 --threads 2"
FREE = f"--hand barrett --object block -n 6 {COMMON}"
# Without a validator, so that not all of them lift.
TABLE = f"--hand barrett --object bottle --scene table --scenes 2 -n 6 --validation none {COMMON}"
PRESSING, CLUTTER = f"{TABLE} --touch -1", f"{TABLE} --with block"


def make(words: str, file: Path, *more: object) -> Path:
    graspd(f"synth {words} -o", file, *more)
    return file
