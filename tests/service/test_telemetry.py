"""Log lines as JSON objects, and the heartbeat file whose age tells health checks who lives."""

import json
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from graspd.service import telemetry
from graspd.service.model.errors import QueueUnavailable
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller
from graspd.service.settings import Settings
from graspd.service.telemetry import HeartbeatFile
from tests.deploy.test_kubernetes import AGE_OF_THE_FILE
from tests.fakes import with_settings
from tests.shell import completed
from tests.waiting import until

log = logging.getLogger("graspd.test")


@pytest.fixture
def written(capsys: pytest.CaptureFixture[str]) -> Iterator[Callable[[], str]]:
    root = logging.getLogger()
    before, level = list(root.handlers), root.level
    yield lambda: capsys.readouterr().err
    logging.captureWarnings(False)
    root.handlers[:] = before
    root.setLevel(level)


def lines(written: Callable[[], str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in written().splitlines()]


def test_a_line_is_one_json_object_with_process_message_and_trace(written: Callable[[], str]) -> None:
    telemetry.set_up_logs(Settings(), "controller")
    try:
        raise ValueError("no")
    except ValueError:
        log.exception("two\nlines, %d", 2)
    (line,) = lines(written)
    assert (line["process"], line["level"], line["logger"]) == ("controller", "ERROR", "graspd.test")
    assert line["message"] == "two\nlines, 2" and line["trace"].endswith("ValueError: no")
    assert line["time"].endswith("Z")


def test_lines_are_about_what_was_bound_around_them_in_their_thread(written: Callable[[], str]) -> None:
    telemetry.set_up_logs(Settings())
    with telemetry.bind_subjects(request="r1", key=""):
        with telemetry.bind_subjects(job="j1"):
            log.info("inside", extra={"task": "t1"})
            thread = threading.Thread(target=lambda: log.info("elsewhere"))
            thread.start()
            thread.join()
        log.info("after")
    inside, elsewhere, after = lines(written)
    assert (inside["request"], inside["job"], inside["task"]) == ("r1", "j1", "t1")
    assert (after["request"], "job" in after, "key" in after) == ("r1", False, False)
    assert "request" not in elsewhere


def test_on_a_terminal_a_message_is_one_line_of_text(written: Callable[[], str]) -> None:
    telemetry.set_up_logs(Settings(log_format="text", log_level="WARNING"))
    log.info("quiet")
    with telemetry.bind_subjects(job="j1"):
        log.warning("GET %s", "/a\r\n12:00:00 ERROR forged\x1b[2J\x9b0m\u2028\u202e")
    said = r" WARNING graspd.test GET /a\r\n12:00:00 ERROR forged\x1b[2J\x9b0m\u2028\u202e [job=j1]"
    (line,) = written().splitlines()
    assert line.endswith(said)


def is_healthy(file: Path) -> bool:
    environment = {**os.environ, "GRASPD_HEARTBEAT_FILE": str(file)}
    return completed(["sh", "-c", AGE_OF_THE_FILE], env=environment).returncode == 0


def test_the_check_follows_the_age_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "alive"
    assert not is_healthy(file)
    HeartbeatFile(file).touch()
    assert is_healthy(file)
    long_ago = time.time() - 200
    os.utime(file, (long_ago, long_ago))
    assert not is_healthy(file)


def test_a_controller_lives_without_redis(services: Services, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "alive"
    watched = with_settings(services, heartbeat_file=file, integrity_scan_mb_per_s=0.0)
    monkeypatch.setattr(services.queue, "depths", Mock(side_effect=QueueUnavailable("Redis does not answer")))
    stop = threading.Event()
    thread = threading.Thread(target=Controller(watched).run, args=(stop,))
    thread.start()
    try:
        until(file.exists, "the file is touched")
    finally:
        stop.set()
        thread.join()


def test_a_file_that_cannot_be_touched_ends_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    alive = HeartbeatFile(tmp_path / "absent" / "alive")
    alive.touch()
    alive.touch()
    assert len(caplog.records) == 1
