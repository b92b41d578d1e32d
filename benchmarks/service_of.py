"""A service of a checkout in an empty folder: jobs over HTTP, processor time of all processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.chain import environment_of

_PATIENCE_S: Final = 300.0
#: Interval between status requests of a job [s]; each takes some milliseconds of the API.
_LOOK_S: Final = 0.1


@dataclass(frozen=True)
class Service:
    url: str
    pid: int
    """Process identifier of the supervisor."""
    ready_s: float
    """Wall time until a worker waited for tasks."""

    def get(self, path: str) -> Any:
        with urllib.request.urlopen(self.url + path, timeout=60) as answer:
            return json.load(answer)

    def job(self, **wanted: Any) -> dict[str, Any]:
        """Submit a job and wait until it has succeeded; return its JSON."""
        asked = urllib.request.Request(
            self.url + "/v1/jobs", json.dumps(wanted).encode(), {"Content-Type": "application/json"}
        )
        with urllib.request.urlopen(asked, timeout=60) as answer:
            job: dict[str, Any] = json.load(answer)
        while job["state"] not in ("succeeded", "failed", "cancelled"):
            time.sleep(_LOOK_S)
            job = self.get(f"/v1/jobs/{job['id']}")
        if job["state"] != "succeeded":
            sys.exit(f"a job {job['state']}: {job.get('reason')}")
        return job

    def processor_s(self) -> float:
        """Return processor seconds of all running processes and of their ended children."""
        parent, ticks = dict[int, int](), dict[int, int]()
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with suppress(OSError):
                fields = stat.read_text().rpartition(")")[2].split()
                parent[int(stat.parent.name)], ticks[int(stat.parent.name)] = (
                    int(fields[1]),
                    sum(map(int, fields[11:15])),
                )
        family = {self.pid}
        while more := {pid for pid, above in parent.items() if above in family} - family:
            family |= more
        return sum(ticks.get(pid, 0) for pid in family) / os.sysconf("SC_CLK_TCK")


@contextmanager
def service_of(root: Path) -> Iterator[Service]:
    """Start a service from a checkout with one idle CPU worker."""
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "up.log").open("w") as log:
        up = [sys.executable, "-m", "graspd", "up", "--port", "0", "--data-dir", folder, "--json"]
        process = subprocess.Popen(
            up,
            cwd=root,
            env=environment_of(root),
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            start_new_session=True,
        )
        try:
            began = time.perf_counter()
            service = Service(_address(process), process.pid, 0.0)
            while not _worker_waits(service):
                if time.perf_counter() - began > _PATIENCE_S:
                    sys.exit("no worker is ready")
                time.sleep(0.1)
            yield Service(service.url, service.pid, time.perf_counter() - began)
        finally:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait(60)


def _address(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    for line in process.stdout:
        for word in line.split():
            if "http://" in word:
                return "http://" + word.partition("http://")[2].strip('",/;')
    sys.exit("the service has not reported its address")


def _worker_waits(service: Service) -> bool:
    with suppress(OSError):
        found = service.get("/v1/workers")
        workers = found.get("items", found.get("workers", [])) if isinstance(found, dict) else found
        return any(worker["state"] == "idle" for worker in workers)
    return False
