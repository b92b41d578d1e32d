"""States, stages, asset kinds and priorities."""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """State of a job or task. A task that lost its worker returns from `running` to `queued`."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_final(self) -> bool:
        return self in (State.SUCCEEDED, State.FAILED, State.CANCELLED)


class Stage(StrEnum):
    """Stage of a task. `ingest` checks uploads; the others make shards."""

    INGEST = "ingest"
    SYNTHESIZE = "synthesize"
    SCENE = "scene"
    RENDER = "render"


class AssetKind(StrEnum):
    """Kinds of uploaded assets. A network proposes grasps of one hand (`service.store.network_file`)."""

    HAND = "hand"
    OBJECT = "object"
    NETWORK = "network"


class Priority(StrEnum):
    """Priority of a task: `interactive` tasks come first, except for every fourth task of a worker."""

    INTERACTIVE = "interactive"
    BULK = "bulk"
