"""Convex pieces of a mesh by CoACD (Wei et al. 2022), which runs in a child process (`_decompose`)."""

import io
import json
import logging
import os
import resource
import signal
import subprocess
import sys
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import manifold3d as m3d
import numpy as np
from numpy.typing import NDArray

from graspd.service import user_cache
from graspd.service.model.transforms import Floats

log = logging.getLogger(__name__)


class WorkLimitExceeded(Exception):
    """A decomposition exceeds its CPU time limit."""


def coacd_parts(vertices: Floats, faces: NDArray[Any], options: Mapping[str, Any], cpu_s: int) -> tuple[Floats, ...]:
    """Compute corners (V, 3) of convex pieces by `coacd.run_coacd` with `options`; none if it fails.
    CoACD holds the interpreter lock, so it runs in a child process and delays no heartbeat. `cpu_s` limits CPU time, so
    that a busy machine gives the same pieces as an idle one. Raises WorkLimitExceeded: CoACD needs more CPU time.
    OSError: CoACD could not start or was killed; without this error, the object would silently get another shape."""
    given = io.BytesIO()
    np.savez(given, vertices=vertices, faces=faces, options=np.array(json.dumps(dict(options))))
    command = [sys.executable, "-m", "graspd.worker.objects.convex", str(cpu_s)]
    try:
        done = subprocess.run(command, input=given.getvalue(), capture_output=True, check=True)
    except subprocess.CalledProcessError as error:
        if error.returncode == -signal.SIGXCPU:
            raise WorkLimitExceeded(f"more than {cpu_s} s of computing") from None
        if error.returncode == -signal.SIGKILL:
            raise OSError("CoACD was killed; the machine may lack memory") from None
        log.warning("CoACD failed: %s", error.stderr.decode(errors="replace").strip()[-200:] or error.returncode)
        return ()
    with np.load(io.BytesIO(done.stdout)) as stored:
        return tuple(stored[name] for name in stored.files)


def union_volume(parts: tuple[Floats, ...]) -> float:
    """Compute the volume of the union of the hulls of the parts [m^3]."""
    solids = [m3d.Manifold.hull_points(np.ascontiguousarray(part * 1e3, np.float32)) for part in parts]
    return float(m3d.Manifold.batch_boolean(solids, m3d.OpType.Add).volume()) * 1e-9 if solids else 0.0


def default_cache() -> Path:
    return user_cache.cache_folder("convex")


def load_parts(file: Path) -> tuple[Floats, ...] | None:
    try:
        with np.load(file) as stored:
            return tuple(stored[name] for name in sorted(stored.files))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def save_parts(file: Path, parts: tuple[Floats, ...]) -> None:
    """Save parts in a file; without a writable folder, they are computed again at the next use."""
    whole = io.BytesIO()
    arrays: dict[str, Any] = {f"{i:04}": part for i, part in enumerate(parts)}
    np.savez(whole, **arrays)
    with suppress(OSError):
        user_cache.write_atomically(file, [whole.getvalue()])


def _decompose(cpu_s: int) -> None:
    """Decompose a mesh from stdin to stdout, both npz; a signal ends the process after `cpu_s`."""
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s if hard == resource.RLIM_INFINITY else min(cpu_s, hard), hard))
    # The library prints to standard output, which carries the result: its output is redirected first.
    result = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    import coacd

    given = np.load(io.BytesIO(sys.stdin.buffer.read()))
    coacd.set_log_level("off")
    mesh = coacd.Mesh(given["vertices"], given["faces"])
    parts = coacd.run_coacd(mesh, **json.loads(str(given["options"])))
    with result:
        np.savez(result, *[np.asarray(corners, float) for corners, _ in parts])


if __name__ == "__main__":
    _decompose(int(sys.argv[1]))
