"""The worker's command."""

from __future__ import annotations

import subprocess
import sys

_ENDING = """
import atexit
from graspd.worker.process.engine import end

class Engine:
    def __del__(self):
        print("taken apart", flush=True)

engine = Engine()
atexit.register(print, "what waited was sent", flush=True)
end()
"""


def test_an_engine_ends_at_once_without_being_taken_apart() -> None:
    """Warp and its kernels take two seconds of computing for that: too long for a busy machine to wait for."""
    done = subprocess.run([sys.executable, "-c", _ENDING], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "what waited was sent\n"), done.stderr


def test_a_worker_is_there_before_its_engine_is() -> None:
    """It says that it lives, and what it checks, before Warp, MuJoCo and the kernels are imported."""
    code = "import sys, graspd.commands.worker, graspd.worker.process.main; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"warp", "mujoco", "scipy", "trimesh", "newton"} & set(done.stdout.split())
