"""What a living worker says about itself; the queue carries it, the index keeps it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from pydantic import Field

from service.model.ability import Ability
from service.model.domain import Word
from service.model.states import Stage

#: Anybody who writes to Redis may say anything: what is read from there is as long and as large as ours can be.
HostWord = Annotated[str, Field(max_length=300)]
Count = Annotated[int, Field(ge=0, lt=2**31)]


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

    @property
    def ability(self) -> Ability:
        """What it can do."""
        return Ability(self.schemas, self.revisions)
