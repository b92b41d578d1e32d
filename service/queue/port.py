"""The queue as the rest of graspd sees it: tasks in, leases and events out. Adapter: `rq_queue`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Final, Protocol

from pydantic import BeforeValidator, ConfigDict, Field

from service.model.base import Model
from service.model.domain import Word
from service.model.messages import IngestMessage, TaskMessage
from service.model.states import Lane, Stage
from service.model.workers import Count, HostWord, WorkerBeat

Message = TaskMessage | IngestMessage


#: Of so many tasks a worker looks for one in bulk first: a steady flow of interactive work must not end all other.
BULK_EVERY: Final = 4


def lane_order(taken: int) -> tuple[Lane, ...]:
    """In which order a worker that took so many tasks before looks for the next one."""
    lanes = (Lane.INTERACTIVE, Lane.BULK)
    return lanes[::-1] if taken % BULK_EVERY == BULK_EVERY - 1 else lanes


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

    @property
    def ends_attempt(self) -> bool:
        """Whether nobody works on the task after it."""
        return self not in (EventKind.STARTED, EventKind.LEFT, EventKind.JOB)


def _cut(value: object) -> object:
    return value[:_LONGEST_MESSAGE] if isinstance(value, str) else value


Amount = Annotated[float, Field(ge=0, le=1e15, allow_inf_nan=False)]
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


class Report(Model):
    """How far a running task is. `total` is 0 where that is unknown."""

    attempt: Count = 0
    done: Amount = 0.0
    total: Amount = 0.0
    message: Annotated[str, BeforeValidator(_cut)] = ""

    model_config = ConfigDict(frozen=True, extra="ignore")


@dataclass(frozen=True)
class Lease:
    """A worker's hold on a task. `beat` changes with every sign of life; only its change has a meaning."""

    task_id: str
    attempt: int
    key: str
    beat: str


@dataclass(frozen=True)
class Holder:
    """Who holds a lease, and what was asked of it."""

    worker: str
    message: Message | None
    """None if Redis no longer knows."""


Place = tuple[Lane, Stage]


@dataclass(frozen=True)
class WorkerPulse:
    """A living worker."""

    device: str
    state: str
    lease_age_s: float
    """Time since its last beat, by Redis's clock."""


@dataclass(frozen=True)
class QueueNow:
    """Waiting and running tasks, and the workers. Places without a task may be left out."""

    depth: Mapping[Place, int] = field(default_factory=dict)
    oldest_s: Mapping[Place, float] = field(default_factory=dict)
    running: Mapping[Place, int] = field(default_factory=dict)
    workers: Mapping[str, WorkerPulse] = field(default_factory=dict)


class Tasks(Protocol):
    """Tasks to workers, and who holds which."""

    def enqueue(self, messages: Sequence[Message], lane: Lane, *, again: bool = False, apart: bool = False) -> int:
        """Append tasks to a lane. A task (by id and attempt) that already waits or runs is not queued twice.

        Args:
            again: the caller has seen that the queue lost these tasks; what it still remembers of them is replaced.
            apart: only some workers of the stage can do them, and only those see them.

        Returns:
            number of tasks added.
        """

    def discard(self, task_ids: Collection[str]) -> None:
        """Take waiting tasks off the queue and tell the workers that run one of them to stop at the next launch."""

    def waiting(self) -> set[str]:
        """Ids of the tasks in the queue."""

    def depths(self) -> dict[tuple[Lane, Stage], int]:
        """Number of waiting tasks of each lane and stage."""

    def clear_untaken(self, present: Collection[WorkerBeat]) -> None:
        """Forget tasks that wait apart for workers of a kind that is gone. The controller then finds them missing."""

    def leases(self) -> list[Lease]:
        """Tasks held by workers, living or dead. Reading changes nothing."""

    def holder(self, lease: Lease) -> Holder:
        """Who holds a lease. Only of one that is lost is this asked: reading all leases stays one round trip."""

    def release(self, lease: Lease) -> None:
        """Forget a lease whose worker is lost; if it lives after all, it notices and stops."""


class Events(Protocol):
    """A bounded stream of what happened."""

    def publish(self, *events: Event) -> None:
        """Append events."""

    def report(self, task_id: str, report: Report) -> float:
        """Say how far a task is, in place of what was said before; gone with the event that ends the attempt.

        Returns:
            time after which more is welcome [s].
        """

    def reports(self) -> dict[str, Report]:
        """The last report on each task."""

    def forget_reports(self, task_ids: Collection[str]) -> None:
        """Take reports away whose tasks nobody holds."""

    def consume(self, *, limit: int, wait_s: float) -> list[tuple[str, Event]]:
        """Next events for the controller, the oldest first; those never acknowledged come again to the next one."""

    def acknowledge(self, event_ids: Sequence[str]) -> None:
        """Say that the events are in the index."""

    def tail(self, after: str, *, limit: int, wait_s: float) -> list[tuple[str, Event]]:
        """Events after an id, for any number of readers. `"$"`: only what comes from now on; `"0"`:
        all kept."""


class Presence(Protocol):
    """Who is there, and how much waits for them: workers, and parts of the service."""

    def workers(self) -> list[WorkerBeat]:
        """Workers that gave a sign of life within the last lease."""

    def announce(self, part: str, seconds: float) -> None:
        """Say that a part of the service (the controller) lives, for that long."""

    def announced(self, part: str) -> bool:
        """Whether a part said so."""

    def service(self) -> str | None:
        """Identity of the service that this queue belongs to; None if none has it yet, or Redis was lost."""

    def set_service(self, identity: str, *, instead: bool = False) -> None:
        """Say which service the queue belongs to, where nobody said it before or `instead` of that."""

    def lead(self, holder: str, seconds: float) -> bool:
        """Lead the controllers for that long, or go on to; False: another one does."""

    def resign(self, holder: str) -> None:
        """Lead no longer; nothing happens where this one does not."""

    def now(self, *, lease_s: float) -> QueueNow:
        """Lengths, ages and workers for the metrics, at a cost that does not grow with the queue.

        Args:
            lease_s: how long a worker's registration outlives its beat [s].
        """


class Counters(Protocol):
    """Sums by name that outlive the processes that add to them."""

    def count(self, amounts: Mapping[str, float]) -> None:
        """Add to sums that outlive this process."""

    def counted(self) -> dict[str, float]:
        """All those sums."""


class TaskQueue(Tasks, Events, Presence, Counters, Protocol):
    """All of the queue, and its connections. Every method raises QueueUnavailable when Redis is away.

    Nothing here is the truth: whatever is lost is queued again from the index. Who needs a part of it takes that port.
    """

    def ping(self) -> float:
        """Seconds a round trip takes."""

    def tidy(self) -> None:
        """Throw away what dead workers and refused entries left behind."""

    def close(self) -> None:
        """Give the connections back."""
