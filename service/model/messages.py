"""Messages of the queue: tasks and their origin."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from graspd.service.model.base import Digest, Model, Name, Word
from graspd.service.model.domain import JobRequest, check_digests
from graspd.service.model.states import AssetKind, Stage


class Origin(Model):
    """Origin of a job, for logs of its tasks and for fair scheduling between keys."""

    request: str = Field("", max_length=64, description="id of the HTTP request")
    key: str = Field("", max_length=64, description="name of the API key")

    model_config = ConfigDict(frozen=True, extra="ignore")


class TaskMessage(Model):
    """Message of a task: with the store, all that a worker needs."""

    # The alias is needed because the message's field `schema` is an attribute of BaseModel.
    schema_: int = Field(alias="schema", description="oldest schema that can express the message")
    newest_schema: int = Field(0, ge=0, description="newest schema that the writer supports; 0: the same as `schema`")
    task_id: Word
    job_id: Word
    stage: Stage
    batch: int = Field(ge=0, description="first batch of the range")
    count: int = Field(ge=1, description="grasps wanted from all batches of the range; all but the last batch are full")
    revision: int = Field(1, ge=1, description="revision of the stage's algorithm, part of the id of the output")
    attempt: int = Field(1, ge=1)
    max_attempt: int = Field(3, ge=1, description="number of the last attempt")
    request: JobRequest
    hand_digest: Digest
    object_digest: Digest
    inputs: tuple[Word, ...] = Field((), description="ids of the shards that the task reads")
    output: Word = Field(description="id of the shard that the task writes")
    origin: Origin | None = None

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    @model_validator(mode="after")
    def _check_digests(self) -> Self:
        check_digests(self.request)
        return self


class IngestMessage(Model):
    """Message of a task that checks an uploaded hand, object or network in a child process."""

    schema_: int = Field(alias="schema")
    newest_schema: int = Field(0, ge=0)
    task_id: Word
    stage: Literal[Stage.INGEST] = Stage.INGEST
    kind: AssetKind
    name: Name
    digest: Digest
    attempt: int = Field(1, ge=1)
    max_attempt: int = Field(3, ge=1)

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


def message_type(raw: Mapping[str, Any]) -> type[TaskMessage | IngestMessage]:
    return IngestMessage if raw.get("stage") == Stage.INGEST else TaskMessage
