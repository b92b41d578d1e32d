"""CoACD in its own process: `python -m graspd.worker.objects.coacd_child SECONDS`, npz in and out.

In: arrays `vertices`, `faces`, and `options` (JSON). Out: corners of each piece. A signal ends it after so many seconds
of CPU time.
"""

from __future__ import annotations

import io
import json
import os
import resource
import sys

import numpy as np


def main(cpu_s: int) -> None:
    """Decompose the mesh on standard input onto standard output."""
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s if hard == resource.RLIM_INFINITY else min(cpu_s, hard), hard))
    # The library prints to standard output, which carries the result: redirect its output first.
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
    main(int(sys.argv[1]))
