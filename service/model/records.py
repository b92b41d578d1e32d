"""JSON records of the store: jobs, datasets, tags, user actions, failed attempts.

`datasets/{name}/dataset.json` lists the jobs of its cells, so that later algorithms or names do not change a dataset.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from graspd.service.model import names
from graspd.service.model.base import Digest, Name, TagName
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_json
from graspd.service.model.domain import JobOptions, JobRequest, check_digests
from graspd.service.model.fidelity import AUTO
from graspd.service.model.messages import IngestMessage, Origin, TaskMessage
from graspd.service.model.projects import Project
from graspd.service.model.states import AssetKind, Priority, Stage
from graspd.service.model.version import STAGE_REVISIONS

MOST_BATCHES: Final = 64


class Record(BaseModel):
    """Base class of records. Unknown fields are ignored, since a newer graspd may have written them."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class FidelityChoice(Record):
    """Fidelity that a chart selected for `auto`, with the reason."""

    target: str = Field(description="required accuracy")
    chart: str = Field(description="key of the chart in the store")
    measured_on: Literal["hand and object", "hand", "all"] = Field(
        description="selected runs of the chart: of the same hand and object, of the same hand, or all"
    )
    reached: float = Field(description="accuracy of the chosen fidelity in these runs")

    def __str__(self) -> str:
        where = "all runs" if self.measured_on == "all" else f"the same {self.measured_on}"
        return f"chosen for {self.target}, reached {self.reached:.3g} with {where} in {self.chart}"


class JobRecord(Record):
    """`job.json`: a request with the exact versions of hand and object, and the revision of each stage."""

    version: Literal[2] = 2
    id: Digest
    request: JobRequest
    revisions: dict[str, int] = Field(default_factory=lambda: dict(STAGE_REVISIONS))
    hand_digest: Digest
    object_digest: Digest
    priority: Priority
    span: int = Field(1, ge=1, le=MOST_BATCHES, exclude_if=lambda value: value == 1, description="batches per task")
    created: str
    origin: Origin | None = None
    owner: str = Field("", max_length=64, description="id of the API key that submitted it; empty: none or unknown")
    project: Project = Field("", description="project of that key; empty: the unnamed project")
    choice: FidelityChoice | None = Field(
        None, exclude_if=lambda value: value is None, description="fidelity that a chart selected for `auto`"
    )

    @model_validator(mode="after")
    def _check_digests(self) -> Self:
        check_digests(self.request)
        if self.span > 1 and (self.request.views or self.request.has_episodes):
            raise ValueError("a task of a job with pictures or episodes has one batch")
        return self

    @property
    def assets(self) -> tuple[tuple[AssetKind, str], ...]:
        further = [(AssetKind.OBJECT, one.digest or "") for one in self.request.all_neighbours]
        further += [(AssetKind.NETWORK, network)] if (network := self.request.network) else []
        return ((AssetKind.HAND, self.hand_digest), (AssetKind.OBJECT, self.object_digest), *further)


class JobEvent(Record):
    """User action on a job. `retried` maps each failed task to its last attempt before the retry."""

    number: int = Field(ge=1)
    what: Literal["cancelled", "retried"]
    at: str
    retried: dict[str, int] = Field(default_factory=dict)
    cause: str = Field("", description="dataset event that caused this job event, as NAME/NUMBER; empty: none")


class AttemptRecord(Record):
    """Failed attempt of a task. `last`: no further attempt unless a user retries the job."""

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
    log: str = Field("", exclude_if=lambda value: not value, description="last lines of the worker's log")

    @classmethod
    def from_message(cls, message: TaskMessage | IngestMessage, **facts: Any) -> Self:
        """Return the record of the message's attempt, which ends now, with further fields `facts`."""
        facts |= {"task_id": message.task_id, "job_id": getattr(message, "job_id", ""), "ended": timestamp()}
        return cls(stage=message.stage, number=message.attempt, **facts)


class DatasetMember(Record):
    """Hand or object of a dataset, in its version at the creation of the dataset."""

    name: Name
    digest: Digest


@dataclass(frozen=True)
class Cell:
    """One hand on one object of a dataset, and its job."""

    position: int
    hand: DatasetMember
    object: DatasetMember
    job_id: str
    fidelity: str = ""
    choice: FidelityChoice | None = None
    """Reason for the chosen fidelity; None also for datasets older than this field."""


class DatasetRecord(Record):
    """`dataset.json`. `jobs` has one id per cell, ordered by hand, then by object.

    With fidelity `auto`, `fidelities` has the chosen fidelity of each cell, and `chosen` the index of its reason in
    `choices`.
    """

    version: Literal[1] = 1
    name: Name
    digest: Digest
    hands: tuple[DatasetMember, ...]
    objects: tuple[DatasetMember, ...]
    options: JobOptions
    revisions: dict[str, int]
    jobs: tuple[Digest, ...]
    fidelities: tuple[str, ...] = ()
    choices: tuple[FidelityChoice, ...] = Field((), exclude_if=lambda value: not value)
    chosen: tuple[Annotated[int, Field(ge=0)], ...] = Field((), exclude_if=lambda value: not value)
    created: str
    owner: str = Field("", max_length=64, description="id of the API key that submitted it; empty: none or unknown")
    project: Project = Field("", description="project of that key; empty: the unnamed project")

    @model_validator(mode="after")
    def _check_job_count(self) -> DatasetRecord:
        if len(self.jobs) != len(self.hands) * len(self.objects):
            raise ValueError("a dataset has a job for each hand and object")
        if len(self.fidelities) != (len(self.jobs) if self.options.fidelity == AUTO else 0):
            raise ValueError("a dataset has a fidelity for each cell if its own is auto, otherwise none")
        if self.chosen and (len(self.chosen) != len(self.jobs) or max(self.chosen) >= len(self.choices)):
            raise ValueError("a dataset has the reasons of chosen fidelities for all cells or for none")
        return self

    def cells(self) -> Iterator[Cell]:
        pairs = ((hand, obj) for hand in self.hands for obj in self.objects)
        for position, ((hand, obj), job) in enumerate(zip(pairs, self.jobs, strict=True)):
            fidelity = self.fidelities[position] if self.fidelities else ""
            choice = self.choices[self.chosen[position]] if self.chosen else None
            yield Cell(position, hand, obj, job, fidelity, choice)


class DatasetEvent(Record):
    """User action on a dataset. The last action decides whether the dataset is cancelled."""

    number: int = Field(ge=1)
    what: Literal["cancelled", "retried"]
    at: str


class SnapshotShard(Record):
    id: Digest
    kind: Literal["base", "scene", "views", "episodes"]
    key: str
    sha256: str
    size_bytes: int
    count: int
    valid: int
    hand: Name
    object: Name
    batch: int

    @field_validator("key")
    @classmethod
    def _convert_pack_key(cls, key: str, info: ValidationInfo) -> str:
        # A key of graspd 0.2 may refer to a part of a pack; now each shard is a file.
        return names.shard_file_key(names.STAGES[info.data["kind"]], info.data["id"]) if "@" in key else key


class Snapshot(Record):
    """Immutable list of the shards of a dataset at one moment."""

    version: Literal[1] = 1
    dataset: Name
    dataset_digest: Digest
    digest: Digest = Field(description="digest of the shards: the same files give the same snapshot")
    complete: bool = Field(description="whether all cells had succeeded")
    grasps: int
    valid: int
    size_bytes: int
    created: str
    shards: tuple[SnapshotShard, ...]


class ObjectSet(Record):
    """Version of a named set of objects; the newest version counts."""

    version: Literal[1] = 1
    name: Name
    digest: Digest
    objects: tuple[Name, ...]
    created: str
    owner: str = ""
    project: Project = ""


def create_job_request(options: JobOptions, hand: str, obj: str, fidelity: str = "") -> JobRequest:
    """Return the request of a cell; `fidelity` replaces `auto` and its target."""
    shared = {name: getattr(options, name) for name in JobOptions.model_fields}
    return JobRequest(hand=hand, object=obj, **shared | ({"fidelity": fidelity, "target": ""} if fidelity else {}))


def create_job_record(
    cell: Cell, options: JobOptions, revisions: dict[str, int], owner: str = "", project: str = ""
) -> JobRecord:
    """Return the job of a cell as planned at the creation of the dataset. Jobs of datasets run in bulk."""
    return JobRecord(
        id=cell.job_id,
        request=create_job_request(options, cell.hand.name, cell.object.name, cell.fidelity),
        revisions=revisions,
        hand_digest=cell.hand.digest,
        object_digest=cell.object.digest,
        priority=Priority.BULK,
        created=timestamp(),
        owner=owner,
        project=project,
        choice=cell.choice,
    )


def create_object_set(
    name: str, objects: Iterable[str], *, after: str = "", owner: str = "", project: str = ""
) -> ObjectSet:
    """Return a version of a set; its digest includes `after`, the digest of the previous version."""
    members = tuple(sorted(set(objects)))
    digest = digest_json([after, *members])
    return ObjectSet(name=name, digest=digest, objects=members, created=timestamp(), owner=owner, project=project)


#: Maximum number of tags of one project (or of one key without a project), and of grasps of one tag.
MOST_TAGS: Final = 100
MOST_TAGGED: Final = 20_000
#: A grasp: shard id and row.
Grasp = tuple[str, int]
Row = Annotated[int, Field(ge=0, lt=2**31)]


class Tag(Record):
    """`tags/{id}/{number:06}.json`: version of a tag; the last one counts, and `gone` marks a deleted tag."""

    version: Literal[1] = 1
    id: Digest
    name: TagName
    number: int = Field(ge=1)
    created: str
    changed: str
    owner: str = Field("", max_length=64, description="id of the API key that created it")
    project: Project = Field("", description="project of the tagged grasps")
    gone: bool = False
    grasps: dict[Digest, tuple[Row, ...]] = Field(default_factory=dict, description="rows of each base shard")

    @property
    def members(self) -> set[Grasp]:
        return {(shard, row) for shard, rows in self.grasps.items() for row in rows}


def tag_id(name: str, project: str) -> str:
    return digest_json(["tag", project, name])


def rows_by_shard(grasps: Iterable[Grasp]) -> Mapping[str, tuple[int, ...]]:
    groups = groupby(sorted(set(grasps)), key=itemgetter(0))
    return {shard: tuple(row for _, row in rows) for shard, rows in groups}
