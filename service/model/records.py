"""Small JSON records that the store keeps besides shards: jobs, what users did to them, failed attempts."""

from __future__ import annotations

from typing import Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from service.model.domain import Digest, JobRequest, check_known
from service.model.messages import Origin
from service.model.projects import Project
from service.model.states import AssetKind, Lane, Stage
from service.model.version import STAGE_REVISIONS

#: Most batches of a task.
MOST_BATCHES: Final = 64


class Record(BaseModel):
    """Base of the records. Unknown fields are ignored: a newer graspd may have written them."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Choice(Record):
    """How a chart put a fidelity in the place of `auto`."""

    target: str = Field(description="the accuracy wanted")
    chart: str = Field(description="key of the chart in the store")
    measured_on: Literal["hand and object", "hand", "all"] = Field(
        description="runs of the chart that counted: those of the same hand and object, of the same hand, or all"
    )
    reached: float = Field(description="the accuracy that the chosen fidelity had there")

    def __str__(self) -> str:
        where = "all of its runs" if self.measured_on == "all" else f"the same {self.measured_on}"
        return f"chosen for {self.target}, reached {self.reached:.3g} with {where} in {self.chart}"


class JobRecord(Record):
    """`job.json`: a request on the very hand and object it was made for, and the revision of each stage that its tasks
    are planned for."""

    version: Literal[1, 2] = 2
    id: Digest
    request: JobRequest
    revisions: dict[str, int] = Field(default_factory=lambda: dict(STAGE_REVISIONS))
    hand_digest: Digest
    object_digest: Digest
    lane: Lane
    span: int = Field(
        1, ge=1, le=MOST_BATCHES, exclude_if=lambda value: value == 1, description="batches of each of its tasks"
    )
    created: str
    origin: Origin | None = None
    owner: str = Field("", max_length=64, description="id of the API key that submitted it; empty: none, or not known")
    project: Project = Field("", description="project of that key; empty: the one without a name")
    choice: Choice | None = Field(
        None, exclude_if=lambda value: value is None, description="of a request with fidelity `auto`"
    )

    @model_validator(mode="before")
    @classmethod
    def _as_it_was_meant(cls, data: Any) -> Any:
        # Records of version 1 knew neither a referee nor revisions.
        if isinstance(data, dict) and data.get("version") == 1:
            request = {"want": "raw", "referee": "none", **data.get("request", {})}
            return {**data, "request": request, "revisions": dict.fromkeys(STAGE_REVISIONS, 1)}
        return data

    @model_validator(mode="after")
    def _knows_its_files(self) -> Self:
        check_known(self.request)
        if self.span > 1 and self.request.views:
            raise ValueError("a task of a job with pictures has one batch")
        return self

    @property
    def assets(self) -> tuple[tuple[AssetKind, str], ...]:
        """Kind and digest of all that it is made of."""
        further = [(AssetKind.OBJECT, one.digest or "") for one in self.request.beside]
        further += [(AssetKind.NETWORK, network)] if (network := self.request.network) else []
        return ((AssetKind.HAND, self.hand_digest), (AssetKind.OBJECT, self.object_digest), *further)


class JobEvent(Record):
    """What a user did to a job later. `retried` maps each failed task to its last attempt that no longer counts."""

    number: int = Field(ge=1)
    what: Literal["cancelled", "retried"]
    at: str
    retried: dict[str, int] = Field(default_factory=dict)
    cause: str = Field("", description="event of the dataset that asked for it: its name, a slash, its number")


class AttemptRecord(Record):
    """A failed attempt of a task. `last`: no further attempt follows unless a user retries the job."""

    task_id: str
    job_id: str
    stage: Stage
    number: int = Field(ge=1)
    kind: str
    reason: str
    trace: str | None = None
    worker: str
    started: str | None = None
    ended: str
    last: bool
