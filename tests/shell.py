"""Commands as users run them."""

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def completed(command: Sequence[str | Path], **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)
