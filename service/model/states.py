"""States, stages, asset kinds and priorities."""

from enum import StrEnum


class State(StrEnum):
    """State of a job or task. A task returns from `running` to `queued` if its worker is lost."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_final(self) -> bool:
        return self in (State.SUCCEEDED, State.FAILED, State.CANCELLED)


class Stage(StrEnum):
    """Stage of a task. `ingest` checks uploads; the other stages make shards."""

    INGEST = "ingest"
    SYNTHESIZE = "synthesize"
    SCENE = "scene"
    RENDER = "render"
    EPISODE = "episode"


class AssetKind(StrEnum):
    """Kind of an uploaded asset. A network proposes grasps of one hand (`service.store.network_file`)."""

    HAND = "hand"
    OBJECT = "object"
    NETWORK = "network"


class Priority(StrEnum):
    """Priority of a task; `interactive` precedes `bulk`, except in every fourth task of a worker."""

    INTERACTIVE = "interactive"
    BULK = "bulk"
