"""What the shared floor may not pull in, so that the image of the API stays small."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from graspd import service
from tests.conftest import PACKAGES

MODULES = sorted(
    "graspd.service."
    + ".".join(path.relative_to(Path(service.__file__).parent).with_suffix("").parts).removesuffix(".__init__")
    for path in Path(service.__file__).parent.rglob("*.py")
    # The readers' module for torch is for those who have it.
    if path.name not in ("__init__.py", "torch_data.py")
)


HEAVY = {"warp", "trimesh", "mujoco", "scipy", "newton", "torch", "graspd.worker", "graspd.api"}


def test_no_line_spells_a_key_of_rq() -> None:
    """RQ itself says where it keeps what: `service.queue.lists` asks it."""
    root = Path(service.__file__).parents[1]
    files = [file for room in PACKAGES for file in (root / room).rglob("*.py")]
    assert [str(file) for file in files if re.search(r"""["']rq:""", file.read_text())] == []


def test_the_shared_floor_is_light() -> None:
    code = f"import sys, {', '.join(MODULES)}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not HEAVY & set(done.stdout.split())
