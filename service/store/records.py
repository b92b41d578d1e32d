"""Small JSON records in the store besides shards: jobs, what users did to them, failed attempts."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal, TypeVar

from pydantic import BaseModel, ValidationError

from service.model import names
from service.model.clock import timestamp
from service.model.errors import DamagedError
from service.model.records import AttemptRecord, JobEvent
from service.model.refusals import refusal
from service.store.seals import is_sealed, put_sealed
from service.store.store import Store

RecordT = TypeVar("RecordT", bound=BaseModel)
#: Writes a record under a key if there is none; whether there was none.
Put = Callable[[str, BaseModel], bool]


def read_record(model: type[RecordT], store: Store, key: str) -> RecordT:
    """A record by its key; NotFoundError if there is none, DamagedError if it is not what its name says."""
    return parse_record(model, store.get(key), key)


def parse_record(model: type[RecordT], data: bytes, key: str) -> RecordT:
    """A record from its bytes; DamagedError if they are not those that were sealed, or hold no such record."""
    is_sealed(key, [data], len(data))
    try:
        return model.model_validate_json(data)
    except ValidationError as error:
        raise DamagedError(
            f"the record {key} in the store is damaged ({refusal(error)}); put a copy in its place, or "
            "remove it and retry its job"
        ) from None


def put_record(store: Store, key: str, record: BaseModel) -> bool:
    """Write a record if there is none yet; False if there was."""
    return put_sealed(store, key, record.model_dump_json().encode())


def job_events(store: Store, job: str) -> list[JobEvent]:
    """What users did to a job, in order."""
    keys = sorted(entry.key for entry in store.list(names.job_events(job)))
    return [read_record(JobEvent, store, key) for key in keys]


def add_job_event(
    store: Store,
    job: str,
    what: Literal["cancelled", "retried"],
    retried: dict[str, int] | None = None,
    *,
    cause: str = "",
    put: Put | None = None,
) -> JobEvent:
    """Append an event after those there are; the state of a job follows from reading them all again, in order."""
    put = put or partial(put_record, store)
    while True:
        taken = [int(entry.key.rsplit("/", 1)[1].partition("-")[0]) for entry in store.list(names.job_events(job))]
        number = max(taken, default=0) + 1
        event = JobEvent(number=number, what=what, at=timestamp(), retried=retried or {}, cause=cause)
        if put(names.job_event(job, event.number, what), event):
            return event


def task_attempts(store: Store, task: str) -> list[AttemptRecord]:
    """Failed attempts of a task, in order."""
    entries = [entry.key for entry in store.list(names.attempts(task))]
    return sorted((read_record(AttemptRecord, store, key) for key in entries), key=lambda attempt: attempt.number)
