"""Blocks of docs/how-to/operations.md and docs/how-to/install.md that are marked as tried, and how to run them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from tests.conftest import REPOSITORY
from tests.shell import completed

TEXT: Final = "\n".join((REPOSITORY / "docs" / "how-to" / page).read_text() for page in ("install.md", "operations.md"))
_TRIED: Final = re.compile(r"<!-- tried: ([\w-]+) -->\n```sh\n(.*?)```", re.DOTALL)


def tried() -> dict[str, str]:
    """Shell text of the marked blocks by name."""
    return dict(_TRIED.findall(TEXT))


def run(name: str, folder: Path, environment: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    """Run a marked block as a user would, `graspd` being that of this environment; a failing line ends it."""
    shims = folder / "bin"
    shims.mkdir(exist_ok=True)
    shim = shims / "graspd"
    shim.write_text(f'#!/bin/sh\nexec {sys.executable} -m graspd "$@"\n')
    shim.chmod(0o755)
    return completed(
        ["bash", "-euo", "pipefail", "-c", tried()[name]],
        cwd=folder,
        env=os.environ | {"PATH": f"{shims}:{os.environ['PATH']}", "PYTHONPATH": str(REPOSITORY)} | dict(environment),
    )
