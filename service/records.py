"""Small JSON records in the store besides shards: jobs, what users did to them, failed attempts."""

from __future__ import annotations

from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from service import names
from service.clock import timestamp
from service.domain import Digest, JobRequest, Lane, Origin, Stage
from service.errors import DamagedError
from service.store import Store
from service.version import STAGE_REVISIONS

RecordT = TypeVar("RecordT", bound=BaseModel)


class Record(BaseModel):
    """Base of the records. Unknown fields are ignored: a newer graspd may have written them."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class JobRecord(Record):
    """`job.json`: a request on the very hand and object it was made for, and the revision of each stage that its tasks
    are planned for."""

    version: Literal[1, 2] = 2
    id: Digest
    request: JobRequest
    revisions: dict[str, int] = Field(default_factory=lambda: dict(STAGE_REVISIONS))
    hand_digest: Digest
    object_digest: Digest
    lane: Lane
    created: str
    origin: Origin | None = None
    owner: str = Field("", max_length=64, description="id of the API key that submitted it; empty: none, or not known")

    @model_validator(mode="before")
    @classmethod
    def _as_it_was_meant(cls, data: Any) -> Any:
        # Records of version 1 knew neither a referee nor revisions.
        if isinstance(data, dict) and data.get("version") == 1:
            request = {"want": "raw", "referee": "none", **data.get("request", {})}
            return {**data, "request": request, "revisions": dict.fromkeys(STAGE_REVISIONS, 1)}
        return data


class JobEvent(Record):
    """What a user did to a job later. `retried` maps each failed task to its last attempt that no longer counts."""

    number: int = Field(ge=1)
    what: Literal["cancelled", "retried"]
    at: str
    retried: dict[str, int] = Field(default_factory=dict)
    cause: str = Field("", description="event of the dataset that asked for it: its name, a slash, its number")


class AttemptRecord(Record):
    """A failed attempt of a task. `last`: no further attempt follows unless a user retries the job."""

    task_id: str
    job_id: str
    stage: Stage
    number: int = Field(ge=1)
    kind: str
    reason: str
    trace: str | None = None
    worker: str
    started: str | None = None
    ended: str
    last: bool


def read_record(model: type[RecordT], store: Store, key: str) -> RecordT:
    """A record by its key; NotFoundError if there is none, DamagedError if it is not what its name says."""
    return parse_record(model, store.get(key), key)


def parse_record(model: type[RecordT], data: bytes, key: str) -> RecordT:
    """A record from its bytes."""
    try:
        return model.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        raise DamagedError(
            f"the record {key} in the store is damaged ({first['loc']}: {first['msg']}); put a copy in its place, or "
            "remove it and retry its job"
        ) from None


def put_record(store: Store, key: str, record: BaseModel) -> bool:
    """Write a record if there is none yet; False if there was."""
    return store.put(key, record.model_dump_json().encode())


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
) -> JobEvent:
    """Append an event after those there are; the state of a job follows from reading them all again, in order."""
    while True:
        taken = [int(entry.key.rsplit("/", 1)[1].partition("-")[0]) for entry in store.list(names.job_events(job))]
        number = max(taken, default=0) + 1
        event = JobEvent(number=number, what=what, at=timestamp(), retried=retried or {}, cause=cause)
        if put_record(store, names.job_event(job, event.number, what), event):
            return event


def task_attempts(store: Store, task: str) -> list[AttemptRecord]:
    """Failed attempts of a task, in order."""
    entries = [entry.key for entry in store.list(names.attempts(task))]
    return sorted((read_record(AttemptRecord, store, key) for key in entries), key=lambda attempt: attempt.number)
