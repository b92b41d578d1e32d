"""Messages in Redis: tasks with origin and requirements, heartbeats and capabilities of workers.

Several versions of graspd may run in parallel. A message states a range of schemas: from the oldest schema that can
express the message to the newest schema of its writer. A worker also reads a range, and has one revision per stage.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from graspd.service.model.base import Digest, Model, Name, Word
from graspd.service.model.clock import timestamp
from graspd.service.model.domain import JobRequest, check_digests
from graspd.service.model.engines import installed_engines
from graspd.service.model.states import AssetKind, Stage
from graspd.service.model.version import OLDEST_TASK_SCHEMA, PACKAGE_VERSION, STAGE_REVISIONS, TASK_SCHEMA


class Origin(Model):
    """Origin of a job, for log lines of its tasks and for fair scheduling."""

    request: str = Field("", max_length=64, description="id of the HTTP request")
    key: str = Field("", max_length=64, description="name of the API key")

    model_config = ConfigDict(frozen=True, extra="ignore")


class _Message(Model):
    # The alias is needed because `schema` is a method of BaseModel.
    schema_: int = Field(alias="schema", description="oldest schema that can express the message")
    newest_schema: int = Field(0, ge=0, description="newest schema that the writer supports; 0: the same as `schema`")
    task_id: Word
    attempt: int = Field(1, ge=1)
    max_attempt: int = Field(3, ge=1, description="number of the last attempt")

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


class TaskMessage(_Message):
    """Message of a task; a worker needs no other data than this message and the store."""

    job_id: Word
    stage: Stage
    batch: int = Field(ge=0, description="first batch of the range")
    count: int = Field(ge=1, description="requested grasps of the range; all batches but the last one are full")
    revision: int = Field(1, ge=1, description="revision of the stage's algorithm, part of the id of the output")
    request: JobRequest
    hand_digest: Digest
    object_digest: Digest
    inputs: tuple[Word, ...] = Field((), description="ids of the shards that the task reads")
    output: Word = Field(description="id of the shard that the task writes")
    origin: Origin | None = None

    @model_validator(mode="after")
    def _check_digests(self) -> Self:
        check_digests(self.request)
        return self


class IngestMessage(_Message):
    """Message of a task that checks an uploaded hand, object or network in a child process."""

    stage: Literal[Stage.INGEST] = Stage.INGEST
    kind: AssetKind
    name: Name
    digest: Digest


def message_type(raw: Mapping[str, Any]) -> type[TaskMessage | IngestMessage]:
    return IngestMessage if raw.get("stage") == Stage.INGEST else TaskMessage


#: Any client can write to Redis, so values from Redis have limited lengths and sizes.
HostWord = Annotated[str, Field(max_length=300)]
Count = Annotated[int, Field(ge=0, lt=2**31)]
Amount = Annotated[float, Field(ge=0, le=1e15, allow_inf_nan=False)]


@dataclass(frozen=True)
class WorkerHeartbeat:
    """Heartbeat of a worker, with its status and progress."""

    name: HostWord
    host: HostWord
    pid: Count
    device: HostWord
    device_name: HostWord
    stages: tuple[Stage, ...]
    version: Annotated[str, Field(max_length=64)]
    state: Annotated[str, Field(max_length=32)]
    """checking, idle, busy, stopping or quarantined."""
    task_id: Word
    started: Annotated[str, Field(max_length=32)]
    seen: Annotated[str, Field(max_length=32)]
    reason: Annotated[str, Field(max_length=300)] = ""
    schemas: tuple[Count, Count] = (0, 0)
    """Oldest and newest schema that the worker reads; (0, 0) for graspd 0.1, whose workers get no tasks."""
    revisions: Annotated[dict[HostWord, Count], Field(max_length=16)] = field(default_factory=dict)
    engines: Annotated[tuple[HostWord, ...], Field(max_length=16)] = ()
    """Installed engines of validation."""
    done: Amount = 0.0
    total: Amount = 0.0
    """Total work of the task, in the unit of `done`; 0: unknown."""
    message: Annotated[str, Field(max_length=300)] = ""

    @classmethod
    def of_this_process(cls, name: str, device: str, stages: Iterable[Stage]) -> Self:
        host, now, own = socket.gethostname(), timestamp(), capabilities()
        facts = (host, os.getpid(), device, "", tuple(stages), PACKAGE_VERSION, "checking", "", now, now)
        return cls(name, *facts, schemas=own.schemas, revisions=dict(own.revisions), engines=own.engines)

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(self.schemas, self.revisions, self.engines)


#: First schema of messages with a range.
FIRST_SCHEMA: Final = 2


@dataclass(frozen=True)
class Requirements:
    stage: Stage
    schema: int
    newest: int
    revision: int
    """Revision of the stage; 0 for ingest, which has no revision."""
    engines: tuple[str, ...] = ()
    """Engines besides MuJoCo."""


@dataclass(frozen=True)
class Capabilities:
    schemas: tuple[int, int]
    revisions: Mapping[str, int]
    engines: tuple[str, ...] = ()

    def unmet_requirement(self, need: Requirements) -> str:
        """Return the first requirement that the worker does not meet, as a sentence; "" if it meets all."""
        oldest, newest = self.schemas
        if need.schema > newest:
            return f"the task needs schema {need.schema}, but the worker reads at most schema {newest}"
        if need.newest < oldest:
            return f"the task has at most schema {need.newest}, but the worker reads schemas from {oldest} on"
        made = self.revisions.get(need.stage.value, 0)
        if need.revision and need.revision != made:
            return f"the task needs revision {need.revision} of {need.stage.value}, but the worker has revision {made}"
        if missing := ",".join(engine for engine in need.engines if engine not in self.engines):
            return f"the task needs engine {missing}, which the worker lacks; run pip install 'graspd[{missing}]' there"
        return ""


def capabilities() -> Capabilities:
    return Capabilities((OLDEST_TASK_SCHEMA, TASK_SCHEMA), STAGE_REVISIONS, installed_engines())


def requirements_of(message: TaskMessage | IngestMessage) -> Requirements:
    revision, engines = 0, tuple[str, ...]()
    if isinstance(message, TaskMessage):
        revision = message.revision
        engines = message.request.second_engines if message.stage is Stage.SYNTHESIZE else ()
    return Requirements(message.stage, message.schema_, message.newest_schema or message.schema_, revision, engines)
