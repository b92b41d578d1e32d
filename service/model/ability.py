"""What a worker must be able to do for a task, and what it says that it can: versions that work side by side.

A message carries a range of schemas: from the oldest that can say what it says to the newest whose meaning its writer
knew. A worker reads a range too, and makes one revision of each stage.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from service.model.messages import IngestMessage, TaskMessage
from service.model.states import Stage
from service.model.version import OLDEST_TASK_SCHEMA, STAGE_REVISIONS, TASK_SCHEMA

#: The first schema with which messages carry a range.
FIRST_SCHEMA: Final = 2


@dataclass(frozen=True)
class Need:
    """What a task asks of its worker."""

    stage: Stage
    schema: int
    """Oldest schema that can say it."""
    newest: int
    """Newest schema whose meaning its writer knew."""
    revision: int
    """Revision of the stage; 0 for the check of an asset, which has none."""


@dataclass(frozen=True)
class Ability:
    """What a worker reads and makes."""

    schemas: tuple[int, int]
    """Oldest and newest schema that it reads."""
    revisions: Mapping[str, int]
    """Revision of each stage."""

    def lacks(self, need: Need) -> str:
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


def own_ability() -> Ability:
    """What this version of graspd reads and makes."""
    return Ability((OLDEST_TASK_SCHEMA, TASK_SCHEMA), STAGE_REVISIONS)


def need_of(message: TaskMessage | IngestMessage) -> Need:
    """What a message asks."""
    revision = message.revision if isinstance(message, TaskMessage) else 0
    return Need(message.stage, message.schema_, message.newest_schema or message.schema_, revision)
