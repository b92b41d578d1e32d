"""A file whose age tells health checks whether a controller or a worker lives."""

from __future__ import annotations

import os
import subprocess
import threading
import time
from pathlib import Path

import pytest

from graspd.service.model.errors import QueueUnavailable
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller
from graspd.service.telemetry import HeartbeatFile
from tests.deploy.test_kubernetes import AGE_OF_THE_FILE
from tests.waiting import until


def is_healthy(file: Path) -> bool:
    """What the health checks of the images say."""
    command = ["sh", "-c", AGE_OF_THE_FILE]
    done = subprocess.run(
        command, env={**os.environ, "GRASPD_HEARTBEAT_FILE": str(file)}, capture_output=True, check=False
    )
    return done.returncode == 0


def test_the_check_follows_the_age_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "alive"
    assert not is_healthy(file)
    HeartbeatFile(file).touch()
    assert is_healthy(file)
    long_ago = time.time() - 200
    os.utime(file, (long_ago, long_ago))
    assert not is_healthy(file)


def test_a_controller_lives_also_while_redis_is_away(
    services: Services, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: object) -> None:
        raise QueueUnavailable("Redis does not answer")

    file = tmp_path / "alive"
    settings = services.settings.model_copy(update={"heartbeat_file": file, "integrity_scan_mb_per_s": 0.0})
    monkeypatch.setattr(services.queue, "depths", away)
    stop = threading.Event()
    thread = threading.Thread(
        target=Controller(Services(settings, services.store, services.index, services.queue)).run, args=(stop,)
    )
    thread.start()
    try:
        until(file.exists, "the file is touched")
    finally:
        stop.set()
        thread.join()


def test_a_file_that_cannot_be_touched_is_said_once_and_ends_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    alive = HeartbeatFile(tmp_path / "absent" / "alive")
    alive.touch()
    alive.touch()
    assert len(caplog.records) == 1
