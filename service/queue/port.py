"""Queue interface: tasks, leases, events. `rq_queue` implements it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, ConfigDict, Field

from graspd.service.model.base import Model, Word
from graspd.service.model.messages import IngestMessage, TaskMessage
from graspd.service.model.states import Priority, Stage
from graspd.service.model.workers import Amount, Count, HostWord, WorkerBeat

Message = TaskMessage | IngestMessage


#: Every n-th task of a worker is bulk first: steady interactive work must not block the rest.
BULK_EVERY: Final = 4


def priority_order(taken: int) -> tuple[Priority, ...]:
    """Return the order of priorities for the next task of a worker that has taken this many."""
    priorities = (Priority.INTERACTIVE, Priority.BULK)
    return priorities[::-1] if taken % BULK_EVERY == BULK_EVERY - 1 else priorities


class EventKind(StrEnum):
    """Type of an event. Events of a task come from its worker, `job` events from controller and API."""

    STARTED = "started"
    FINISHED = "finished"
    FAILED = "failed"
    """An attempt failed and is recorded in the store."""
    DEFERRED = "deferred"
    """A part of the service did not answer; the attempt does not count."""
    RETURNED = "returned"
    """A stopping worker returned the task; the attempt does not count."""
    CANCELLED = "cancelled"
    LEFT = "left"
    """A worker ended regularly; it is not lost."""
    JOB = "job"
    """The job's state changed; `message` is the new state."""


_LONGEST: Final = 2000


class Event(Model):
    """One event of a task or job."""

    kind: EventKind
    at: Annotated[str, Field(max_length=32)]
    task_id: Word = ""
    job_id: Word = ""
    stage: Stage | None = None
    batch: Count = 0
    attempt: Count = 0
    worker: HostWord = ""
    message: Annotated[str, BeforeValidator(lambda text: text[:_LONGEST] if isinstance(text, str) else text)] = ""
    last: bool = False
    seconds: Amount = 0.0
    output: Annotated[str, Field(pattern=r"^([a-z]{1,10}/)?[A-Za-z0-9_-]{0,64}$")] = ""
    """Shard id of a finished stage; kind and digest (`hand/...`) of a finished check."""

    # A newer worker may send more fields than an older controller has.
    model_config = ConfigDict(frozen=True, extra="ignore")


@dataclass(frozen=True)
class Lease:
    """Lease of a worker on a task."""

    task_id: str
    attempt: int
    key: Any
    beat: str
    """Value that changes with every heartbeat; only the change has a meaning."""


Place = tuple[Priority, Stage]


@dataclass(frozen=True)
class QueueStatus:
    """Numbers of waiting and running tasks (some zeros omitted); living workers by name, with the time
    since their last heartbeat by Redis's clock [s].
    """

    depth: Mapping[Place, int] = field(default_factory=dict)
    oldest_s: Mapping[Place, float] = field(default_factory=dict)
    running: Mapping[Place, int] = field(default_factory=dict)
    workers: Mapping[str, tuple[WorkerBeat, float]] = field(default_factory=dict)
