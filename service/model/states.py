"""States and kinds of what graspd works on."""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """State of a job or a task. A task that lost its worker goes from `running` back to `queued`."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_final(self) -> bool:
        return self in (State.SUCCEEDED, State.FAILED, State.CANCELLED)


class Stage(StrEnum):
    """What a task does. `ingest` checks what was uploaded; the others make shards."""

    INGEST = "ingest"
    SYNTHESIZE = "synthesize"
    SCENE = "scene"
    RENDER = "render"


class AssetKind(StrEnum):
    """The kinds of things a user brings. A network proposes grasps of one hand (`service.store.network_file`)."""

    HAND = "hand"
    OBJECT = "object"
    NETWORK = "network"


class Priority(StrEnum):
    """Priority of a task: `interactive` goes first, but for every fourth task that a worker takes."""

    INTERACTIVE = "interactive"
    BULK = "bulk"
