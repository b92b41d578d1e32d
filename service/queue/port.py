"""What goes into the queue and comes out of it: tasks, leases, events. `rq_queue` carries them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, ConfigDict, Field

from graspd.service.model.base import Model
from graspd.service.model.domain import Word
from graspd.service.model.messages import IngestMessage, TaskMessage
from graspd.service.model.states import Priority, Stage
from graspd.service.model.workers import Amount, Count, HostWord, WorkerBeat

Message = TaskMessage | IngestMessage


#: Of so many tasks a worker looks for one in bulk first: a steady flow of interactive work must not end all other.
BULK_EVERY: Final = 4


def priority_order(taken: int) -> tuple[Priority, ...]:
    """In which order a worker that took so many tasks before looks for the next one."""
    priorities = (Priority.INTERACTIVE, Priority.BULK)
    return priorities[::-1] if taken % BULK_EVERY == BULK_EVERY - 1 else priorities


class EventKind(StrEnum):
    """What happened. Events of a task come from its worker, `job` events from the controller and the API."""

    STARTED = "started"
    FINISHED = "finished"
    FAILED = "failed"
    """An attempt ended in an error and is recorded in the store."""
    DEFERRED = "deferred"
    """A part of the service did not answer; the attempt does not count."""
    RETURNED = "returned"
    """The worker was told to stop and handed the task back; the attempt does not count."""
    CANCELLED = "cancelled"
    LEFT = "left"
    """A worker ended as it should; it is not lost."""
    JOB = "job"
    """The job's state changed; `message` is the new state."""


def _cut(value: object) -> object:
    return value[:_LONGEST_MESSAGE] if isinstance(value, str) else value


_LONGEST_MESSAGE: Final = 2000


class Event(Model):
    """One thing that happened to a task or a job."""

    kind: EventKind
    at: Annotated[str, Field(max_length=32)]
    task_id: Word = ""
    job_id: Word = ""
    stage: Stage | None = None
    batch: Count = 0
    attempt: Count = 0
    worker: HostWord = ""
    message: Annotated[str, BeforeValidator(_cut)] = ""
    last: bool = False
    seconds: Amount = 0.0
    output: Annotated[str, Field(pattern=r"^([a-z]{1,10}/)?[A-Za-z0-9_-]{0,64}$")] = ""
    """Shard id of a finished stage; kind and digest (`hand/...`) of a finished check."""

    # A newer worker may say more than an older controller knows.
    model_config = ConfigDict(frozen=True, extra="ignore")


@dataclass(frozen=True)
class Lease:
    """A worker's hold on a task."""

    task_id: str
    attempt: int
    key: Any
    """Where the queue keeps it."""
    beat: str
    """Another one with every sign of life; only its change has a meaning."""


Place = tuple[Priority, Stage]


@dataclass(frozen=True)
class QueueStatus:
    """Waiting and running tasks; the living workers by name, each with the time since its last beat by Redis's clock
    [s]. Places without a task may be left out."""

    depth: Mapping[Place, int] = field(default_factory=dict)
    oldest_s: Mapping[Place, float] = field(default_factory=dict)
    running: Mapping[Place, int] = field(default_factory=dict)
    workers: Mapping[str, tuple[WorkerBeat, float]] = field(default_factory=dict)
