"""Reports of living workers, their capabilities, and the requirements of tasks: versions that work side by side.

A message carries a range of schemas: from the oldest that can say what it says to the newest whose meaning its writer
knew. A worker reads a range too, and makes one revision of each stage.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Final, Self

from pydantic import Field

from graspd.service.model.clock import timestamp
from graspd.service.model.domain import Word
from graspd.service.model.messages import IngestMessage, TaskMessage
from graspd.service.model.states import Stage
from graspd.service.model.version import OLDEST_TASK_SCHEMA, PACKAGE_VERSION, STAGE_REVISIONS, TASK_SCHEMA

#: Anybody who writes to Redis may say anything: what is read from there is as long and as large as ours can be.
HostWord = Annotated[str, Field(max_length=300)]
Count = Annotated[int, Field(ge=0, lt=2**31)]
Amount = Annotated[float, Field(ge=0, le=1e15, allow_inf_nan=False)]


@dataclass(frozen=True)
class WorkerBeat:
    """What a living worker says about itself."""

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
    """Why it is in quarantine."""
    schemas: tuple[Count, Count] = (0, 0)
    """Oldest and newest task message that it reads; graspd 0.1 does not say it, and its workers are given no task."""
    revisions: Annotated[dict[HostWord, Count], Field(max_length=16)] = field(default_factory=dict)
    """Revision that it makes of each stage."""
    done: Amount = 0.0
    total: Amount = 0.0
    """How far its task is; 0 where the end is not known."""
    message: Annotated[str, Field(max_length=300)] = ""

    @classmethod
    def of_this_process(cls, name: str, device: str, stages: Iterable[Stage]) -> Self:
        """What a worker says before its first check."""
        now, own = timestamp(), own_ability()
        facts = (
            socket.gethostname(),
            os.getpid(),
            device,
            "",
            tuple(stages),
            PACKAGE_VERSION,
            "checking",
            "",
            now,
            now,
        )
        return cls(name, *facts, schemas=own.schemas, revisions=dict(own.revisions))

    @property
    def ability(self) -> Capabilities:
        """What it can do."""
        return Capabilities(self.schemas, self.revisions)


#: The first schema with which messages carry a range.
FIRST_SCHEMA: Final = 2


@dataclass(frozen=True)
class Requirements:
    """What a task asks of its worker."""

    stage: Stage
    schema: int
    """Oldest schema that can say it."""
    newest: int
    """Newest schema whose meaning its writer knew."""
    revision: int
    """Revision of the stage; 0 for the check of an asset, which has none."""


@dataclass(frozen=True)
class Capabilities:
    """What a worker reads and makes."""

    schemas: tuple[int, int]
    """Oldest and newest schema that it reads."""
    revisions: Mapping[str, int]
    """Revision of each stage."""

    def lacks(self, need: Requirements) -> str:
        """Why such a worker cannot do a task; "" if it can."""
        oldest, newest = self.schemas
        if need.schema > newest:
            return f"schema {need.schema} of tasks is needed, and {newest} is the newest known"
        if need.newest < oldest:
            return f"schema {need.newest} of tasks is the newest it may have, and {oldest} the oldest known"
        made = self.revisions.get(need.stage.value, 0)
        if need.revision and need.revision != made:
            return f"revision {need.revision} of {need.stage.value} is needed, and revision {made} is made"
        return ""


def own_ability() -> Capabilities:
    """What this version of graspd reads and makes."""
    return Capabilities((OLDEST_TASK_SCHEMA, TASK_SCHEMA), STAGE_REVISIONS)


def need_of(message: TaskMessage | IngestMessage) -> Requirements:
    """What a message asks."""
    revision = message.revision if isinstance(message, TaskMessage) else 0
    return Requirements(message.stage, message.schema_, message.newest_schema or message.schema_, revision)
