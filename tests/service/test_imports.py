"""What the shared floor may not pull in, so that the image of the API stays small."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import service

MODULES = sorted(
    "service."
    + ".".join(path.relative_to(Path(service.__file__).parent).with_suffix("").parts).removesuffix(".__init__")
    for path in Path(service.__file__).parent.rglob("*.py")
    # The readers' module for torch is for those who have it.
    if path.name not in ("__init__.py", "torch_data.py")
)


HEAVY = {"warp", "trimesh", "mujoco", "scipy", "newton", "torch", "worker", "api"}


def test_the_shared_floor_is_light() -> None:
    code = f"import sys, {', '.join(MODULES)}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not HEAVY & set(done.stdout.split())
