"""Commands as users run them."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def completed(command: Sequence[str | Path], **options: Any) -> subprocess.CompletedProcess[str]:
    """A command that has ended, however it did, with what it said."""
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)
