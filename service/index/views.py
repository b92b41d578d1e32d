"""Results of index queries: frozen models, ready for JSON. Times are RFC 3339 in UTC."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, computed_field

from graspd.service.model.domain import JobOptions, JobRequest
from graspd.service.model.metric_fields import insert_fields, value_fields
from graspd.service.model.planning import explain_shortfall
from graspd.service.model.records import FidelityChoice
from graspd.service.model.states import AssetKind, Priority, Stage, State

T = TypeVar("T")


class View(BaseModel):
    model_config = ConfigDict(frozen=True)


class Page(View, Generic[T]):
    """Page of a list. `next` is the cursor of the next page, None at the end."""

    items: list[T]
    next: str | None = None


class Validated(View):
    """Numbers of grasps and of candidates. The yield omits grasps without validation."""

    grasps: int = Field(0, description="grasps stored so far")
    valid: int = Field(0, description="feasible grasps that held in validation; 0 without validation")
    candidates: int = Field(0, description="candidates planned for these grasps, stored or not")
    validated: int = Field(0, description="candidates tested for geometric limits and validated; 0 without validation")

    @computed_field(description="valid grasps per validated candidate; null: not validated")  # type: ignore[prop-decorator]
    @property
    def valid_yield(self) -> float | None:
        return self.valid / self.validated if self.validated else None


class StageProgress(View):
    """Tasks of one stage of a job, by state. `done` counts finished tasks and shares of running ones."""

    stage: Stage
    tasks: int
    queued: int = 0
    running: int = 0
    succeeded: int = 0
    failed: int = 0
    cancelled: int = 0
    done: float = 0.0
    reused: int = Field(0, description="succeeded tasks whose shard another job had already made")
    seconds: float = Field(0.0, description="total time of the finished tasks, without reused ones [s]")


class JobView(Validated):
    id: str
    state: State
    priority: Priority
    request: JobRequest
    hand_digest: str
    object_digest: str
    created: str
    owner: str = Field("", description="id of the key that submitted it; empty: none or unknown")
    project: str = Field("", description="its project; empty: the unnamed project")
    finished: str | None
    choice: FidelityChoice | None = Field(None, description="how a chart replaced the fidelity auto, if requested")
    reason: str | None = Field(None, description="why the job failed: error of its first failed task")
    stages: list[StageProgress] = []
    rechecked: int = Field(0, description="valid grasps validated again under the unmodified DexGraspBench protocol")
    recheck_held: int = Field(0, description="rechecked grasps that held")
    second_tested: int = Field(0, description="valid grasps that the second engine validated")
    second_held: int = Field(0, description="those that it held")
    outcomes: dict[str, int] = Field({}, description="rejected candidates by outcome")
    episodes: dict[str, int] = Field({}, description="episodes by outcome")
    phases: dict[str, float] = Field({}, description="time of each phase of synthesis [s]: planner, validation, ...")
    seconds_by_device: dict[str, float] = Field({}, description="time of finished tasks by device, without reused [s]")

    @computed_field(description="why fewer grasps than requested were found; null: not applicable")  # type: ignore[prop-decorator]
    @property
    def note(self) -> str | None:
        request = self.request
        found = self.valid if request.counted_status == "valid" else self.grasps
        if self.state is not State.SUCCEEDED or request.want != "valid":
            return None
        return explain_shortfall(request, found, self.candidates, self.outcomes)


class TaskView(View):
    id: str
    job_id: str
    stage: Stage
    batch: int
    count: int
    state: State
    shard_id: str
    attempt: int = Field(description="number of the current or next attempt, from 1")
    worker: str | None
    device: str | None
    done: float
    total: float
    message: str | None
    reason: str | None
    seconds: float | None
    finished: str | None


class AttemptView(View):
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
    kind: str = Field(description="base, scene, views or episodes")
    stage: Stage
    key: str
    sha256: str
    size_bytes: int
    count: int = Field(
        description="base shard: grasps; scene shard: transferred grasps, or scenes if grasps are planned in them; "
        "views shard: pictures; episodes shard: executed and refused grasps"
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
    manifest: dict[str, Any] = Field(default_factory=dict, description="complete manifest, only in `get_shard`")


@insert_fields(valid=value_fields(optional=False), created=value_fields(optional=True))
class GraspView(View):
    """Grasp with its indexed metrics; contact metrics apply to the manifest's contact threshold (5 mm)."""

    shard_id: str
    row: int
    hand: str
    object: str
    valid: bool
    success: bool | None = Field(description="whether it held in validation; None: not validated")
    verdict_level: str | None = Field(description="level of validation of that verdict")
    scene_kind: str = Field("free", description="kind of scene in which it was planned; free: around a floating object")
    neighbours: int = Field(0, description="number of neighbours in that scene")
    lift_hard: bool | None = Field(None, description="in a scene: lifted at half friction; None: not tested")
    robust_weakest: str | None = Field(
        None, description="perturbed parameter of the first model in which it fails; None: held in all, or not tested"
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
    owner: str = Field("", description="id of the key that uploaded it; empty: none or unknown")
    project: str = Field("", description="its project; empty: the unnamed project")
    shared: bool = Field(False, description="whether all projects may use it")
    verdict: str | None = Field(description="accept, repair or refuse; None: not checked yet")
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
    reason: str = Field("", description="reason of the quarantine")


class FailureGroup(View):
    stage: str
    kind: str
    attempts: int
    tasks: int
    example: str
    task_id: str
    last_seen: str


class Stats(Validated):
    jobs: dict[State, int]
    tasks: dict[State, int]
    shards: int
    bytes: int
    workers: int


class EndView(View):
    """Ended job or dataset."""

    seq: int = Field(description="sequence number, larger for later ends; value of `since` in the next request")
    kind: Literal["job", "dataset"]
    subject: str = Field(description="id of the job, or name of the dataset")
    state: State = Field(description="succeeded, failed or cancelled")
    at: str
    project: str = Field("", description="its project; empty: the unnamed project")
    owner: str = Field("", description="id of the key that submitted it; empty: none or unknown")


class WebhookView(View):
    """URL that is notified when a job or dataset ends."""

    id: str
    url: str
    states: list[str] = Field(description="final states that are reported: succeeded, failed, cancelled")
    created: str
    owner: str = Field("", description="id of the key that created it")
    project: str = Field("", description="project whose jobs and datasets it reports")
    seen: int = Field(0, description="sequence number of the last ended job or dataset with created deliveries")


class TagView(View):
    """User's name for grasps."""

    id: str
    name: str
    created: str
    changed: str
    owner: str = Field("", description="id of the key that created it")
    project: str = Field("", description="its project; empty: the unnamed project")
    grasps: int = Field(0, description="existing grasps with this tag")


class DeliveryView(View):
    """Notification of a URL about an ended job or dataset, and its result."""

    seq: int
    kind: str
    subject: str
    ended: str = Field(description="succeeded, failed or cancelled")
    state: str = Field(description="waiting, delivered or failed")
    attempts: int
    tried: str | None = Field(description="time of the last attempt")
    status: int | None = Field(description="HTTP status of the last response")
    detail: str = Field(description="result of the last attempt")


class UsageDay(View):
    """Daily usage of a project: tasks that ended on that day and that this project requested first."""

    project: str = Field(description="empty: the unnamed project")
    day: str = Field(description="UTC day, from midnight to midnight")
    grasps: int
    valid: int
    tasks: int
    gpu_seconds: float = Field(description="total time of GPU workers for these tasks [s]")
    cpu_seconds: float = Field(description="total time of CPU workers for these tasks [s]")


class MatrixCell(Validated):
    """Totals of the jobs of one hand on one object."""

    hand: str
    object: str
    jobs: int
    queued: int
    running: int
    failed: int


class DatasetView(Validated):
    """Totals of a dataset. `grasps`, `valid` and `candidates` count base shards made so far."""

    name: str
    digest: str = Field(description="digest of hands, objects and options")
    state: State
    hands: list[str]
    objects: list[str]
    options: JobOptions = Field(description="options of each cell")
    cells: int
    states: dict[State, int] = Field(description="cells by state; cells without a planned job count as queued")
    asked: int = Field(description="grasps requested in all cells")
    tasks: int
    tasks_done: int
    tasks_failed: int
    progress: float = Field(ge=0, le=1)
    seconds: float = Field(description="total worker time [s]")
    eta_s: float | None = Field(description="expected time until the end, at the current number of running tasks [s]")
    shards: int
    size_bytes: int
    created: str
    owner: str = Field("", description="id of the key that submitted it; empty: none or unknown")
    project: str = Field("", description="its project; empty: the unnamed project")
    finished: str | None
    cancelled: bool = Field(description="whether its user cancelled it; `retry` resumes it")
    outcomes: dict[str, int] = Field({}, description="rejected candidates by outcome")
    phases: dict[str, float] = Field({}, description="time of each phase of synthesis [s]: planner, validation, ...")
    seconds_by_device: dict[str, float] = Field({}, description="time of finished tasks by device, without reused [s]")

    @computed_field(description="why fewer grasps than requested were found; null: not applicable")  # type: ignore[prop-decorator]
    @property
    def reason(self) -> str | None:
        if not self.state.is_final or self.options.want != "valid":
            return None
        found = self.counted_grasps
        return explain_shortfall(self.options, found, self.candidates, self.outcomes, wanted=self.asked)

    @property
    def counted_grasps(self) -> int:
        """Number of grasps that count: valid ones, or all stored ones if validation is off."""
        return self.valid if self.options.displayed_status == "valid" else self.grasps


class CellView(Validated):
    """One hand on one object of a dataset: a job, planned or not."""

    position: int = Field(description="index of the cell, ordered by hand, then by object, from 0")
    hand: str
    object: str
    job_id: str
    fidelity: str = Field("", description="name of the fidelity; in a dataset with `auto`, the chart's choice")
    choice: FidelityChoice | None = Field(None, description="how a chart chose the fidelity")
    planned: bool = Field(description="whether the job exists")
    state: State
    asked: int = Field(description="grasps requested")
    tasks: int
    tasks_done: int
    tasks_failed: int
    attempts_failed: int = Field(description="failed attempts, including those followed by a successful one")
    progress: float = Field(ge=0, le=1)
    seconds: float = Field(description="total worker time [s]")
    reason: str | None = Field(description="why it failed, or found fewer grasps than requested")

    def counted_grasps(self, options: JobOptions) -> int:
        """Number of grasps that count: valid ones, or all stored ones if validation is off."""
        return self.valid if options.displayed_status == "valid" else self.grasps


class SnapshotView(View):
    """Snapshot of a dataset, without its list of shards."""

    dataset: str
    digest: str
    created: str
    complete: bool = Field(description="whether all cells had succeeded")
    shards: int
    grasps: int
    valid: int
    size_bytes: int

    def counted_grasps(self, options: JobOptions) -> int:
        """Number of grasps that count: valid ones, or all stored ones if validation is off."""
        return self.valid if options.displayed_status == "valid" else self.grasps


class ObjectSetView(View):
    name: str
    digest: str
    objects: list[str]
    created: str
    project: str = Field("", description="its project; empty: the unnamed project")
