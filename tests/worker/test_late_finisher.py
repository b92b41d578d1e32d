"""A worker that was slow, and whose task was taken from it meanwhile, ends it without a fuss."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest

from service.domain import Lane, Stage, TaskMessage
from service.queue.rq_queue import RqQueue
from service.settings import Settings
from tests.fakes import fake_synthesize, message_for
from worker.context import TaskContext
from worker.main import run_worker


def test_a_task_that_was_taken_away_ends_in_a_line_and_no_traceback(
    rq_queue: RqQueue, redis_server: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def slow(message: TaskMessage, context: TaskContext) -> Any:
        (lease,) = rq_queue.leases()
        rq_queue.release(lease)
        return fake_synthesize(message, TaskContext(context.store))

    rq_queue.enqueue([message_for()], Lane.BULK)
    settings = Settings(redis_url=redis_server, data_dir=tmp_path, device="cpu")  # type: ignore[arg-type]
    with caplog.at_level(logging.INFO):
        assert run_worker(settings, table={Stage.SYNTHESIZE: slow}, burst=True)
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING] == []
    assert [record for record in caplog.records if "was taken from this worker" in record.getMessage()]
    assert not rq_queue.connection.keys("rq:job:*"), "nothing is left of it"
