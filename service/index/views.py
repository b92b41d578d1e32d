"""Answers of the index: plain frozen records, ready for JSON. Times are RFC 3339 in UTC."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, computed_field

from graspd.service.model.domain import JobOptions, JobRequest
from graspd.service.model.metric_fields import values, with_fields
from graspd.service.model.planning import shortfall
from graspd.service.model.records import Choice
from graspd.service.model.states import AssetKind, Priority, Stage, State

T = TypeVar("T")


class View(BaseModel):
    """Base of the answers."""

    model_config = ConfigDict(frozen=True)


class Page(View, Generic[T]):
    """Part of a list. `next` is the cursor of the next part, None at the end."""

    items: list[T]
    next: str | None = None


class Validated(View):
    """Number of grasps, and how many are valid. Those without validation are no failures and omitted."""

    grasps: int = Field(0, description="grasps kept so far")
    valid: int = Field(
        0, description="of these, valid: past the geometric gate and validated to hold; 0 where nothing is validated"
    )
    candidates: int = Field(0, description="grasps planned for them, kept or not")
    validated: int = Field(
        0, description="of these, validated by the geometric gate and a validator; 0 where nothing is validated"
    )

    @computed_field(description="valid grasps per grasp validated; null: not validated")  # type: ignore[prop-decorator]
    @property
    def valid_yield(self) -> float | None:
        """Share of valid grasps among the validated ones."""
        return self.valid / self.validated if self.validated else None


class StageProgress(View):
    """Tasks of one stage of a job, by state. `done` counts finished tasks plus shares of running ones."""

    stage: Stage
    tasks: int
    queued: int = 0
    running: int = 0
    succeeded: int = 0
    failed: int = 0
    cancelled: int = 0
    done: float = 0.0
    reused: int = Field(0, description="of the succeeded tasks, those whose shard another job had made before")
    seconds: float = Field(0.0, description="sum over the finished tasks, without the reused ones [s]")


class JobView(Validated):
    id: str
    state: State
    priority: Priority
    request: JobRequest
    hand_digest: str
    object_digest: str
    created: str
    owner: str = Field("", description="id of the key that submitted it; empty: none, or not known")
    project: str = Field("", description="project that it belongs to; empty: the one without a name")
    finished: str | None
    choice: Choice | None = Field(None, description="how a chart chose its fidelity, where the request said auto")
    reason: str | None = Field(None, description="why the job failed: the first failed task's last attempt")
    stages: list[StageProgress] = []
    rechecked: int = Field(0, description="valid grasps validated again under the unmodified DexGraspBench protocol")
    recheck_held: int = Field(0, description="of these, grasps that held")
    outcomes: dict[str, int] = Field({}, description="candidates that were not kept, by what became of them")

    @computed_field(description="what a reader of the numbers should know")  # type: ignore[prop-decorator]
    @property
    def note(self) -> str | None:
        """Note on a job that ended with fewer valid (unvalidated: feasible) grasps than requested."""
        request = self.request
        found = self.valid if request.counted == "valid" else self.grasps
        if self.state is not State.SUCCEEDED or request.want != "valid":
            return None
        return shortfall(found, request.grasps, request.counted, self.candidates, request.budget, self.outcomes)


class TaskView(View):
    id: str
    job_id: str
    stage: Stage
    batch: int
    count: int
    state: State
    shard_id: str
    attempt: int = Field(description="number of the present or next attempt, from 1")
    worker: str | None
    device: str | None
    done: float
    total: float
    message: str | None
    reason: str | None
    seconds: float | None
    finished: str | None


class AttemptView(View):
    """A failed attempt of a task."""

    task_id: str
    number: int
    reason: str
    kind: str = Field(description="name of the error, or WorkerLost")
    trace: str | None
    worker: str
    started: str | None
    ended: str
    last: bool


class ShardView(View):
    id: str
    kind: str = Field(description="base, scene or views")
    stage: Stage
    key: str
    sha256: str
    size_bytes: int
    count: int = Field(
        description="grasps of a base shard; transferred grasps of a scene shard, or its scenes where these come "
        "first; pictures of a view shard"
    )
    hand: str
    object: str
    hand_digest: str
    object_digest: str
    batch: int
    seed: int
    inputs: list[str]
    device: str
    worker: str
    seconds: float
    created: str
    manifest: dict[str, Any] = Field(default_factory=dict, description="whole, only in `get_shard`")


@with_fields(valid=values(optional=False), created=values(optional=True))
class GraspView(View):
    """One grasp with its quality in the index; the contact thresholds are those of the manifest (5 mm)."""

    shard_id: str
    row: int
    hand: str
    object: str
    valid: bool
    success: bool | None = Field(description="verdict of the validator; None: not tested")
    verdict_level: str | None = Field(description="level of the validator that gave it")
    scene_kind: str = Field("free", description="kind of the scene it was planned in; free: around a floating object")
    neighbours: int = Field(0, description="other objects that stood in that scene")
    lift_hard: bool | None = Field(None, description="in a scene: lifted at half the friction; None: not tested")
    robust_weakest: str | None = Field(
        None, description="axis of the first model in which it does not hold; None: held in all, or not validated there"
    )
    created: str

    if TYPE_CHECKING:

        def __getattr__(self, metric: str) -> float | None: ...


class AssetView(View):
    kind: AssetKind
    name: str
    digest: str
    filename: str
    files: list[str]
    size_bytes: int
    created: str
    builtin: bool
    owner: str = Field("", description="id of the key that uploaded it; empty: none, or not known")
    project: str = Field("", description="project that it belongs to; empty: the one without a name")
    shared: bool = Field(False, description="whether every project may use it")
    verdict: str | None = Field(description="accept, repair or refuse; None: the check is still to come")
    message: str | None
    repairs: list[str]
    facts: dict[str, Any]


class WorkerView(View):
    name: str
    host: str
    pid: int
    device: str
    device_name: str
    stages: list[Stage]
    version: str
    state: str = Field(description="checking, idle, busy, stopping, quarantined or lost")
    task_id: str | None
    started: str
    seen: str
    reason: str = Field("", description="why it is in quarantine")


class FailureGroup(View):
    """Failed attempts that share an error name and stage."""

    stage: str
    kind: str
    attempts: int
    tasks: int
    example: str
    task_id: str
    last_seen: str


class Stats(Validated):
    """Totals of the whole service."""

    jobs: dict[State, int]
    tasks: dict[State, int]
    shards: int
    bytes: int
    workers: int


class Throughput(View):
    """Production of one interval."""

    start: str
    grasps: int
    valid: int
    tasks: int
    seconds: float


class EndView(View):
    """A job or a dataset that ended."""

    seq: int = Field(description="later ends have larger numbers; `since` of the next request")
    kind: Literal["job", "dataset"]
    subject: str = Field(description="id of the job, or name of the dataset")
    state: State = Field(description="succeeded, failed or cancelled")
    at: str
    project: str = Field("", description="project that it belongs to; empty: the one without a name")
    owner: str = Field("", description="id of the key that submitted it; empty: none, or not known")


class WebhookView(View):
    """An address that receives ends."""

    id: str
    url: str
    states: list[str] = Field(description="ends that it is told of: succeeded, failed, cancelled")
    created: str
    owner: str = Field("", description="id of the key that made it")
    project: str = Field("", description="whose jobs and datasets it is told of")
    seen: int = Field(0, description="ends up to this number have deliveries")


class TagView(View):
    """A name that a user gave to grasps."""

    id: str
    name: str
    created: str
    changed: str
    owner: str = Field("", description="id of the key that made it")
    project: str = Field("", description="project that it belongs to; empty: the one without a name")
    grasps: int = Field(0, description="grasps that have it and are there")


class DeliveryView(View):
    """Result of a delivery of an end to an address."""

    seq: int
    kind: str
    subject: str
    ended: str = Field(description="succeeded, failed or cancelled")
    state: str = Field(description="waiting, delivered or failed")
    attempts: int
    tried: str | None = Field(description="when it was tried last")
    status: int | None = Field(description="HTTP status of the last answer")
    detail: str = Field(description="how the last attempt ended")


class UsageDay(View):
    """Usage of a project on a day: the tasks that ended then, counted for their first requester."""

    project: str = Field(description="empty: the one without a name")
    day: str = Field(description="from midnight to midnight UTC")
    grasps: int
    valid: int
    tasks: int
    gpu_seconds: float = Field(description="time that GPU workers spent on them [s]")
    cpu_seconds: float = Field(description="time that CPU workers spent on them [s]")


class MatrixCell(Validated):
    """One hand x object of the matrix."""

    hand: str
    object: str
    jobs: int
    queued: int
    running: int
    failed: int


class DatasetView(Validated):
    """Totals of a dataset. `grasps`, `valid` and `candidates` count base shards made so far."""

    name: str
    digest: str = Field(description="equal hands, objects and options have the same digest")
    state: State
    hands: list[str]
    objects: list[str]
    options: JobOptions = Field(description="what each cell asks for")
    cells: int
    states: dict[State, int] = Field(description="cells by state; a cell whose job is not planned yet is queued")
    asked: int = Field(description="grasps asked for, over all cells")
    tasks: int
    tasks_done: int
    tasks_failed: int
    progress: float = Field(ge=0, le=1)
    seconds: float = Field(description="time that workers spent on it [s]")
    eta_s: float | None = Field(description="expected time until it ends with as many tasks at work as now [s]")
    shards: int
    size_bytes: int
    created: str
    owner: str = Field("", description="id of the key that submitted it; empty: none, or not known")
    project: str = Field("", description="project that it belongs to; empty: the one without a name")
    finished: str | None
    cancelled: bool = Field(description="cancelled by its user; `retry` lifts it")
    outcomes: dict[str, int] = Field({}, description="candidates that were not kept, by what became of them")

    @computed_field(description="why it ended with fewer grasps than asked for")  # type: ignore[prop-decorator]
    @property
    def reason(self) -> str | None:
        """Note on a dataset that ended with fewer grasps than requested."""
        if not self.state.is_final or self.options.want != "valid":
            return None
        options = self.options
        return shortfall(self.counted, self.asked, options.counted, self.candidates, options.budget, self.outcomes)

    @property
    def counted(self) -> int:
        """Grasps that count under its options: valid ones, else all."""
        return self.valid if self.options.standing == "valid" else self.grasps


class CellView(Validated):
    """One hand x object of a dataset: an ordinary job, or one to be planned."""

    position: int = Field(description="hand by hand, and in each hand object by object, from 0")
    hand: str
    object: str
    job_id: str
    fidelity: str = Field("", description="its name; of a dataset with `auto`, what the chart promised for this cell")
    choice: Choice | None = Field(None, description="how a chart chose that fidelity")
    planned: bool = Field(description="whether the job exists yet")
    state: State
    asked: int = Field(description="grasps asked for")
    tasks: int
    tasks_done: int
    tasks_failed: int
    attempts_failed: int = Field(description="attempts that failed, those that were repeated with success too")
    progress: float = Field(ge=0, le=1)
    seconds: float = Field(description="time that workers spent on it [s]")
    reason: str | None = Field(description="why it failed, or found fewer grasps than asked for")

    def counted(self, options: JobOptions) -> int:
        """Return the grasps that count under its dataset's options: valid ones, else all."""
        return self.valid if options.standing == "valid" else self.grasps


class SnapshotView(View):
    """A snapshot of a dataset, without its list of shards."""

    dataset: str
    digest: str
    created: str
    complete: bool = Field(description="every cell had succeeded")
    shards: int
    grasps: int
    valid: int
    size_bytes: int

    def counted(self, options: JobOptions) -> int:
        """Return the grasps that count under its dataset's options: valid ones, else all."""
        return self.valid if options.standing == "valid" else self.grasps


class ObjectSetView(View):
    """The newest version of a named set of objects."""

    name: str
    digest: str
    objects: list[str]
    created: str
    project: str = Field("", description="project that it belongs to; empty: the one without a name")
