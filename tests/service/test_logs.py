"""Log lines: one JSON object each, with what they are about."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from graspd.service import telemetry
from graspd.service.settings import Settings

log = logging.getLogger("graspd.test")


@pytest.fixture
def written(capsys: pytest.CaptureFixture[str]) -> Iterator[Callable[[], str]]:
    """What this process writes to stderr; logging is as it was afterwards."""
    root = logging.getLogger()
    before, level = list(root.handlers), root.level
    yield lambda: capsys.readouterr().err
    logging.captureWarnings(False)
    root.handlers[:] = before
    root.setLevel(level)


def lines(written: Callable[[], str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in written().splitlines()]


def test_a_line_is_one_json_object_with_process_and_message(written: Callable[[], str]) -> None:
    telemetry.set_up_logs(Settings(), "controller")
    log.info("two\nlines, %d", 2)
    (line,) = lines(written)
    assert (line["process"], line["level"], line["logger"]) == ("controller", "INFO", "graspd.test")
    assert line["message"] == "two\nlines, 2"
    assert line["time"].endswith("Z")


def test_lines_are_about_what_was_bound_around_them(written: Callable[[], str]) -> None:
    telemetry.set_up_logs(Settings())
    with telemetry.bind(request="r1", key=""):
        with telemetry.bind(job="j1"):
            log.info("inside", extra={"task": "t1"})
        log.info("after")
    log.info("outside")
    inside, after, outside = lines(written)
    assert (inside["request"], inside["job"], inside["task"]) == ("r1", "j1", "t1")
    assert (after["request"], "job" in after, "key" in after) == ("r1", False, False)
    assert "request" not in outside


def test_one_thread_is_not_about_what_another_binds(written: Callable[[], str]) -> None:
    telemetry.set_up_logs(Settings())
    with telemetry.bind(job="j1"):
        thread = threading.Thread(target=lambda: log.info("elsewhere"))
        thread.start()
        thread.join()
    assert "job" not in lines(written)[0]


def test_an_error_brings_its_trace_in_the_same_line(written: Callable[[], str]) -> None:
    telemetry.set_up_logs(Settings())
    try:
        raise ValueError("no")
    except ValueError:
        log.exception("it broke")
    (line,) = lines(written)
    assert line["trace"].endswith("ValueError: no")


def test_on_a_terminal_a_message_writes_no_line_of_its_own(written: Callable[[], str]) -> None:
    telemetry.set_up_logs(Settings(log_format="text"))
    log.info("GET %s", "/a\r\n12:00:00 ERROR forged\x1b[2J\x9b0m\u2028\u202e")
    (line,) = written().splitlines()
    assert line.endswith(r"GET /a\r\n12:00:00 ERROR forged\x1b[2J\x9b0m\u2028\u202e")


def test_on_a_terminal_a_line_is_text(written: Callable[[], str]) -> None:
    telemetry.set_up_logs(Settings(log_format="text"))
    with telemetry.bind(job="j1"):
        log.warning("careful")
    assert written().endswith(" WARNING graspd.test careful [job=j1]\n")


def test_lines_below_the_level_are_not_written(written: Callable[[], str]) -> None:
    telemetry.set_up_logs(Settings(log_level="WARNING"))
    log.info("quiet")
    assert written() == ""
