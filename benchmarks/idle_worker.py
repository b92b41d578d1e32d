"""Memory and start time of an idle CPU worker, for two checkouts; prints Markdown.

usage: python -m benchmarks.idle_worker BEFORE AFTER [--runs 3]

Memory counts private pages; the table has the run with the least in total. Runs of both checkouts alternate."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from graspd.service.queue.connection import connect, redis_url
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.run.embedded import server_command
from graspd.service.settings import Settings

_LONGEST_S = 300.0


def family(pid: int) -> Iterator[int]:
    yield pid
    for thread in Path(f"/proc/{pid}/task").iterdir():
        for child in (thread / "children").read_text().split():
            yield from family(int(child))


def private_mb(pid: int) -> float:
    """Return the private memory of a process [MiB]."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("Private_")) / 1024


def measure(checkout: Path) -> tuple[float, list[float]]:
    """Return the time until a worker of a checkout is idle [s], and the memory of each process [MiB]."""
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(data_dir=Path(folder))  # type: ignore[call-arg]
        redis = subprocess.Popen(server_command(settings), stdout=subprocess.DEVNULL)
        queue = RqQueue(connect(redis_url(settings), patience=20))
        queue.ping()
        began = time.monotonic()
        environment = {**os.environ, "PYTHONPATH": str(checkout), "GRASPD_DATA_DIR": folder, "GRASPD_DEVICE": "cpu"}
        worker = subprocess.Popen(
            [sys.executable, "-m", "graspd", "worker"], cwd=checkout, env=environment, stderr=subprocess.DEVNULL
        )
        try:
            while not any(beat.state == "idle" for beat in queue.workers()):
                if time.monotonic() - began > _LONGEST_S:
                    raise TimeoutError(f"the worker of {checkout} does not get ready")
                time.sleep(0.02)
            seconds = time.monotonic() - began
            time.sleep(2.0)  # until temporary memory of the start is released
            return seconds, sorted(private_mb(pid) for pid in family(worker.pid))
        finally:
            worker.terminate()
            worker.wait()
            queue.close()
            redis.terminate()
            redis.wait()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--runs", type=int, default=3)
    wanted = parser.parse_args()
    checkouts = {"before": wanted.before.resolve(), "after": wanted.after.resolve()}
    runs = [{name: measure(checkout) for name, checkout in checkouts.items()} for _ in range(wanted.runs)]
    lines = ["| | processes | memory of each [MiB] | together | idle after [s] |", "| --- | --: | --: | --: | --: |"]
    for name in checkouts:
        memory = min((run[name][1] for run in runs), key=sum)
        each = ", ".join(f"{part:.0f}" for part in memory)
        seconds = min(run[name][0] for run in runs)
        lines.append(f"| {name} | {len(memory)} | {each} | {sum(memory):.0f} | {seconds:.1f} |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
