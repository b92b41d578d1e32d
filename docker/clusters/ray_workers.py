"""Workers on a Ray cluster. Ray places them and starts them again; tasks, results and retries are graspd's own.

    ray job submit --working-dir docker/clusters -- python ray_workers.py --workers 16 --gpus 1

graspd is installed on the nodes (an image, or a `pip` of the runtime environment), and `GRASPD_REDIS_URL`,
`GRASPD_STORE_URL` and the variables of the store are set where this runs: they are handed on.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence

import ray

#: Variables that a worker gets from here: its settings, and the credentials of the store.
HANDED_ON = ("GRASPD_", "AWS_", "GOOGLE_", "AZURE_", "OTEL_")


def run_worker(command: Sequence[str], environment: Mapping[str, str]) -> int:
    """A worker until no task waits; its exit code. It ends with the process that Ray runs this in."""
    # A worker that Ray has lost sight of would go on beside the one that takes its place.
    tied = [sys.executable, "-m", "service.run.launch", str(os.getpid()), *command]
    done = subprocess.run(tied, env={**os.environ, **environment}, check=False)
    if done.returncode:
        raise RuntimeError(f"a worker ended with code {done.returncode}; graspd doctor on {os.uname().nodename}")
    return done.returncode


def main(arguments: Sequence[str] | None = None) -> None:
    """Start the workers and wait until all have ended."""
    options = argparse.ArgumentParser(description="Workers of graspd on a Ray cluster.")
    options.add_argument("--workers", type=int, default=1)
    options.add_argument("--cpus", type=float, default=4, help="of one worker; its threads")
    options.add_argument("--gpus", type=float, default=0, help="of one worker")
    options.add_argument("--idle", type=int, default=60, help="a worker ends when no task came for so long [s]")
    options.add_argument("--retries", type=int, default=20, help="how often one that was lost is started again")
    options.add_argument("--graspd", nargs="+", default=[sys.executable, "-m", "graspd"], help="the command")
    wanted = options.parse_args(arguments)

    environment = {name: value for name, value in os.environ.items() if name.startswith(HANDED_ON)}
    threads = str(max(1, int(wanted.cpus)))
    command = [*wanted.graspd, "worker", "--burst", "--idle", str(wanted.idle), "--threads", threads]
    if wanted.gpus:
        command += ["--device", "auto"]
    ray.init()
    place = ray.remote(
        num_cpus=wanted.cpus, num_gpus=wanted.gpus, max_retries=wanted.retries, retry_exceptions=True, max_calls=1
    )(run_worker)
    waiting = [place.remote(command, environment) for _ in range(wanted.workers)]
    sys.stdout.write(f"{len(waiting)} workers are on their way\n")
    ray.get(waiting)


if __name__ == "__main__":
    main()
