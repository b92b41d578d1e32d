"""How far running tasks are: one field of a hash for each, so that what is late replaces what was not yet read."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from pydantic import ValidationError

from service.queue.entries import text
from service.queue.port import Report
from service.queue.rates import report_every_s

REPORTS: Final = "graspd:reports"


def put_report(connection: Any, task_id: str, report: Report, workers_key: str) -> float:
    """One round trip: replace what was said of a task, and learn when to say more [s]."""
    with connection.pipeline(transaction=False) as pipe:
        pipe.hset(REPORTS, task_id, report.model_dump_json())
        pipe.scard(workers_key)
        return report_every_s(pipe.execute()[1])


def read_reports(connection: Any) -> dict[str, Report]:
    """The last report on each task; one that cannot be read says nothing."""
    found = {}
    for raw, data in connection.hgetall(REPORTS).items():
        try:
            found[text(raw)] = Report.model_validate_json(data)
        except ValidationError:
            found[text(raw)] = Report()
    return found


def drop_reports(connection: Any, task_ids: Iterable[str]) -> None:
    if ids := list(task_ids):
        connection.hdel(REPORTS, *ids)
