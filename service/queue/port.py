"""Types of the queue: events, leases, status. `rq_queue` implements the queue."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, ConfigDict, Field

from graspd.service.model.base import Model, Word
from graspd.service.model.messages import Amount, Count, HostWord, IngestMessage, TaskMessage, WorkerHeartbeat
from graspd.service.model.states import Priority, Stage

Message = TaskMessage | IngestMessage
#: For every n-th task, a worker reads bulk lists first, so that steady interactive work does not block bulk work.
BULK_EVERY: Final = 4


def priority_order(taken: int) -> tuple[Priority, ...]:
    """Return the order of priorities for a worker's next task after `taken` tasks."""
    priorities = (Priority.INTERACTIVE, Priority.BULK)
    return priorities[::-1] if taken % BULK_EVERY == BULK_EVERY - 1 else priorities


class EventKind(StrEnum):
    """Type of an event. Workers send events of tasks; controller and API send `job` events."""

    STARTED = "started"
    FINISHED = "finished"
    FAILED = "failed"
    """An attempt failed and is recorded in the store."""
    DEFERRED = "deferred"
    """The worker could not run the task at present, for example without the store; the attempt does not count."""
    RETURNED = "returned"
    """A stopping worker returned the task; the attempt does not count."""
    CANCELLED = "cancelled"
    LEFT = "left"
    JOB = "job"
    """The job's state changed; `message` is the new state."""


_LONGEST: Final = 2000
#: Longest log of a task [characters].
MOST_LOG: Final = 64_000


class Event(Model):
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

    # A newer worker may send more fields than an older controller knows.
    model_config = ConfigDict(frozen=True, extra="ignore")


def rq_id(task_id: str, attempt: int) -> str:
    """Return the RQ job id of an attempt; a slow worker thus cannot affect a later attempt."""
    return f"{task_id}-{attempt}"


@dataclass(frozen=True)
class Lease:
    task_id: str
    attempt: int
    key: Any
    beat: str
    """Value that changes with every heartbeat and has no other meaning."""


Place = tuple[Priority, Stage]


@dataclass(frozen=True)
class QueueStatus:
    """Numbers of waiting and running tasks; living workers, with heartbeat age [s] by Redis's clock."""

    depth: Mapping[Place, int] = field(default_factory=dict)
    oldest_s: Mapping[Place, float] = field(default_factory=dict)
    running: Mapping[Place, int] = field(default_factory=dict)
    workers: Mapping[str, tuple[WorkerHeartbeat, float]] = field(default_factory=dict)
