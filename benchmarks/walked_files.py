"""Count source files with functions called by `graspd synth -n 1`, POST /v1/jobs and GET /grasps.

usage: python -m benchmarks.walked_files

`graspd synth` runs in a fresh interpreter, imports included. The service answers each request once before the count."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import typer

PACKAGES = ("api", "baselines", "exchange", "graspd", "service", "studies", "worker")
ROOT = Path(__file__).resolve().parent.parent
JOB = {"hand": "allegro", "object": "mug", "grasps": 4}
_called: set[str] = set()
_counting = threading.Event()


def _profile(frame: FrameType, event: str, _: Any) -> None:
    if event == "call" and _counting.is_set() and frame.f_code.co_flags & 1:  # functions, not bodies of classes
        _called.add(frame.f_code.co_filename)


@contextmanager
def counted(found: dict[str, int], what: str) -> Iterator[None]:
    _called.clear()
    _counting.set()
    yield
    _counting.clear()
    files = {Path(file).resolve() for file in _called}
    found[what] = sum(file.is_relative_to(ROOT) and file.relative_to(ROOT).parts[0] in PACKAGES for file in files)


def synth(folder: str) -> dict[str, int]:
    found: dict[str, int] = {}
    sys.argv = ["graspd", "synth", "--hand", "allegro", "--object", "mug", "-n", "1", "-o", f"{folder}/grasp.h5"]
    with counted(found, "graspd synth -n 1"):
        from graspd.cli import main

        try:
            main()
        except SystemExit as ended:
            assert not ended.code
    return found


def requests(folder: str) -> dict[str, int]:
    from fastapi.testclient import TestClient

    from graspd.api.app import create_app
    from graspd.service.pipeline.backends import Services
    from graspd.service.run.embedded import server_command
    from graspd.service.settings import Settings
    from tests.api.factories import add_builtins

    settings = Settings(data_dir=Path(folder), host="127.0.0.1")
    redis = subprocess.Popen(server_command(settings), stdout=subprocess.DEVNULL)
    found: dict[str, int] = {}
    try:
        services = Services.open(settings, patience=20)
        services.queue.ping()
        add_builtins(services)
        with TestClient(create_app(settings, services), base_url="http://127.0.0.1") as client:
            client.post("/v1/jobs", json={**JOB, "seed": 1})
            client.get("/grasps")
            with counted(found, "POST /v1/jobs"):
                assert client.post("/v1/jobs", json=JOB).status_code == 202
            with counted(found, "GET /grasps"):
                assert client.get("/grasps").status_code == 200
    finally:
        redis.kill()
    return found


if __name__ == "__main__":
    threading.setprofile(_profile)
    sys.setprofile(_profile)
    with tempfile.TemporaryDirectory() as place:
        if sys.argv[1:] == ["synth"]:
            typer.echo("\n" + json.dumps(synth(place)))
        else:
            alone = [sys.executable, "-m", "benchmarks.walked_files", "synth"]
            lines = subprocess.run(alone, check=True, capture_output=True, text=True).stdout.splitlines()
            for what, files in {**json.loads(lines[-1]), **requests(place)}.items():
                typer.echo(f"{what}: {files} files")
