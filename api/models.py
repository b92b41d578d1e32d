"""API models that extend those of the index. Times are RFC 3339 in UTC; field names contain units."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from graspd.service.index.views import AttemptView, GraspView, ShardView, StageProgress, TagView, Validated, WorkerView
from graspd.service.model.base import Digest, TagName
from graspd.service.model.domain import JobRequest
from graspd.service.model.metric_fields import OfferedName, filter_fields, insert_fields, mean_fields
from graspd.service.model.metrics import AXIS_WORDS, DIRECTION_CELLS
from graspd.service.model.records import FidelityChoice
from graspd.service.model.scene_spec import Box, HalfSpace, SceneKind
from graspd.service.model.states import Stage, State
from graspd.service.model.where import LONGEST


class StageStatus(StageProgress):
    """Progress of one stage of a job, and its expected end."""

    state: State
    progress: float = Field(ge=0, le=1, description="finished share; running tasks count with their progress")
    message: str = Field("", description="activity of a running task, or why a task waits")
    rate_per_s: float | None = Field(None, description="tasks per second, by all current workers")
    eta_s: float | None = Field(None, description="expected time until the stage ends [s]")


class Job(Validated):
    """Job as shown in lists."""

    id: str
    state: State
    hand: str
    object: str
    method: str
    fidelity: str
    requested: int = Field(description="grasps requested")
    standing: Literal["valid", "feasible", "kept"] = Field(
        "valid", description="stored grasps: valid ones, feasible ones (not validated), or all candidates (kept)"
    )
    progress: float = Field(ge=0, le=1)
    eta_s: float | None = Field(None, description="expected time until the job ends [s]; null if unknown")
    created: str
    owner: str = Field("", description="id of the key that submitted it; empty if none or unknown")
    project: str = Field("", description="its project; empty for the unnamed project")
    finished: str | None = None
    reason: str | None = Field(None, description="why it failed, or found fewer grasps than requested")
    stages: list[StageStatus]


@insert_fields(last=mean_fields())
class MeanMetrics(BaseModel):
    """Means over a job's valid grasps (all stored ones if not validated); null while there are none."""

    if TYPE_CHECKING:

        def __getattr__(self, metric: str) -> float | None: ...


class Diversity(BaseModel):
    """Diversity of a job's valid grasps, or of all its stored grasps if not validated."""

    grasps: int = Field(description="number of grasps analysed")
    types: dict[str, int] = Field(description="number of grasps by type; `none`: undefined type")
    type_entropy_bits: float = Field(description="entropy of the types; 0: one type; 1.58: three equal types")
    directions_used: int = Field(description="approach cells with grasps; directions are in the object's frame")
    directions: int = Field(DIRECTION_CELLS, description="number of cells, all of equal area")
    direction_entropy_bits: float = Field(description="entropy of the directions; 0: one cell; 5.58: 48 equal cells")
    evenness: float = Field(ge=0, le=1, description="2^entropy of the directions, divided by the number of cells")


class Shard(ShardView):
    """Shard and its download address."""

    file: str


class JobDetail(Job):
    """Job with its request, failed attempts and results."""

    request: JobRequest
    hand_digest: str
    object_digest: str
    choice: FidelityChoice | None = Field(None, description="how a chart resolved the fidelity auto, if requested")
    note: str | None = Field(None, description="why fewer grasps than requested were found; null if enough")
    outcomes: dict[str, int] = Field({}, description="rejected candidates by outcome")
    episodes: dict[str, int] = Field({}, description="episodes by outcome")
    phases: dict[str, float] = Field({}, description="time of each phase of synthesis [s]: planner, validation, ...")
    seconds_by_device: dict[str, float] = Field({}, description="time of finished tasks by device, without reused [s]")
    rechecked: int = Field(0, description="valid grasps validated again under the unmodified DexGraspBench protocol")
    recheck_held: int = Field(0, description="rechecked grasps that held")
    second_tested: int = Field(0, description="valid grasps that the second engine validated")
    second_held: int = Field(0, description="those that it held")
    attempts: list[AttemptView]
    mean: MeanMetrics
    diversity: Diversity | None = Field(None, description="null without grasps")
    shards: list[Shard]


@insert_fields(sort=filter_fields())
class GraspQuery(BaseModel):
    """Filters and order of a list of grasps. A range excludes grasps whose metric is unknown."""

    model_config = ConfigDict(extra="forbid")

    job: str | None = Field(None, max_length=64)
    dataset: str | None = Field(None, max_length=64, description="grasps of the cells of this dataset")
    tag: str | None = Field(None, max_length=64, description="grasps with this tag")
    where: str | None = Field(None, max_length=LONGEST, description="filter expression: `epsilon > 0.3 and lift`")
    hand: str | None = Field(None, max_length=64)
    object: str | None = Field(None, max_length=64)
    validated: bool | None = Field(None, description="whether the validator gave a verdict")
    valid: bool | None = Field(None, description="false: validated, but not valid")
    success: bool | None = None
    type: Literal["power", "precision", "pinch", "lateral"] | None = Field(
        None, description="grasp type; pinch: precision with thumb and one finger"
    )
    scene: Literal["free", "table", "bin", "shelf", "file", "any"] | None = Field(
        None, description="kind of the scene in which it was planned; any: all kinds except free"
    )
    neighbours: bool | None = Field(None, description="whether the scene has neighbours")
    lift_hard: bool | None = Field(None, description="lifted at half friction")
    robust_weakest: Literal[AXIS_WORDS] | None = Field(  # type: ignore[valid-type]
        None, description="perturbed parameter of the first model in which it fails"
    )
    sort: OfferedName = "epsilon"
    order: Literal["asc", "desc"] = "desc"


class Posture(BaseModel):
    """Posture of the hand in the object frame."""

    hand_pose: list[float] = Field(description="pose of the root link: x y z [m], quaternion w x y z")
    joint_positions: list[float] = Field(description="joint positions in the order of joint_names [rad or m]")


class Waypoint(Posture):
    """One posture on the trajectory of a grasp, in the frame of the object at rest."""

    name: str = Field(description="standoff, pregrasp, grasp, squeeze, lift; empty between them")
    place: float = Field(description="position on a slider: named postures at 0, 1, 2, ..., others evenly spaced")
    carried: list[float] = Field(description="displacement of the object from rest: x y z [m]")


class ReplayPoint(Posture):
    """State of a replayed validation, in the frame of the object at rest [m, N, N m]."""

    name: str = Field(description="named posture as in `Waypoint`, or pushes; empty between them")
    place: float = Field(description="position on the slider of `Waypoint`; all after the squeeze takes one unit")
    phase: str = Field(description="approach, closing, lifting, holding, or the direction of a push")
    object_pose: list[float] = Field(description="pose relative to rest: x y z, quaternion w x y z")
    contacts: list[list[float]] = Field(
        [], description="contacts of the object: position, inward normal, force on it, torque, 1 if the hand touches"
    )
    load: list[float] | None = Field(None, description="weight or push at the object's centre of mass")


class GraspReplay(BaseModel):
    """Validation of a grasp, simulated again in MuJoCo at nominal friction."""

    outcome: str
    way: list[ReplayPoint]


class Neighbour(BaseModel):
    """Neighbour of the target in a scene."""

    name: str
    digest: str
    pose: list[float] = Field(description="pose in the scene: x y z [m], quaternion w x y z")


class GraspScene(BaseModel):
    """Scene that a grasp was planned in; its frame has z up."""

    kind: SceneKind
    number: int = Field(description="row of the scene in its shard")
    object_pose: list[float] = Field(description="pose of the object at rest: x y z [m], quaternion w x y z")
    supports: list[HalfSpace | Box]
    neighbours: list[Neighbour] = Field(default_factory=list)
    clearance_m: float | None = Field(None, description="least distance of the hand from supports and neighbours")
    lift: str | None = Field(None, description="outcome of the lift test; null if not tested")
    lift_hard: bool | None = Field(None, description="whether it lifts at half friction; null if not tested")


class Push(BaseModel):
    """Outcome of one push by the validator."""

    direction: str
    outcome: str


class GraspEpisode(BaseModel):
    """Execution of a grasp by a robot."""

    shard_id: str = Field(description="episodes shard")
    robot: str = Field(description="flying: the hand alone; else the arm")
    outcome: str = Field(description="succeeded, or why not")
    films: dict[str, str] = Field(description="address of the film of each camera, if the grasp was executed")


class GraspDetail(GraspView):
    """One grasp with its postures and its data in the shard."""

    hand_digest: str
    object_digest: str
    joint_names: list[str]
    postures: dict[str, Posture] = Field(description="pregrasp, grasp, squeeze")
    thresholds_m: list[float] = Field(description="contact thresholds of `sweep`")
    sweep: dict[str, list[float | None]] = Field(description="metrics at each threshold")
    way: list[Waypoint] = Field(description="trajectory from the standoff, if any, to the squeeze or the lift")
    scene: GraspScene | None = Field(None, description="scene in which it was planned; null for a free object")
    pushes: list[Push] = Field(description="verdict per direction of push; empty if not validated")
    verdict_margin: float | None = Field(None, description="largest ratio of motion to its limit; held if below 1")
    validated_by: Literal["mujoco", "mujoco_warp"] | None = Field(
        None, description="engine of the verdict: MuJoCo on the CPU (the reference) or MuJoCo Warp (the prefilter)"
    )
    recheck: bool | None = Field(None, description="verdict at level `dexgraspbench`; null if not rechecked")
    friction: float | None = Field(None, description="Coulomb coefficient of the metrics")


class GraspPageQuery(GraspQuery):
    """One page of a list of grasps."""

    limit: int = Field(50, ge=1, le=200, description="items on a page")
    cursor: str | None = Field(None, max_length=512, description="`next` of the previous page")


class GraspExportQuery(GraspQuery):
    """Selection of grasps to export, and the format."""

    format: Literal["csv", "json", "zip"] = Field("csv", description="zip: base shards with these grasps only")


class GraspName(BaseModel):
    """Identifier of a grasp: its shard and row."""

    model_config = ConfigDict(extra="forbid")

    shard_id: Digest
    row: int = Field(ge=0, lt=2**31)


class Selection(BaseModel):
    """Selection of grasps: listed by name, or all that pass a filter."""

    model_config = ConfigDict(extra="forbid")

    grasps: list[GraspName] | None = Field(None, min_length=1, max_length=5000)
    filter: GraspQuery | None = None

    @model_validator(mode="after")
    def _is_one_of_both(self) -> Self:
        if (self.grasps is None) == (self.filter is None):
            raise ValueError("give either names of grasps or a filter")
        return self


class TagRequest(Selection):
    """Request to give grasps a tag."""

    name: TagName


class TagChange(BaseModel):
    """Result of giving or removing a tag."""

    tag: TagView
    changed: int = Field(description="number of grasps that gained or lost the tag")


class Part(BaseModel):
    """State of one part that the API needs."""

    ok: bool
    latency_ms: float | None = Field(None, description="response time [ms]; null without a response")
    detail: str = ""


class Health(BaseModel):
    """Readiness of the service and of its parts."""

    ok: bool = Field(description="whether redis, index and store respond")
    parts: dict[str, Part]
    controller: bool = Field(False, description="whether a controller sent a heartbeat recently; it queues all tasks")
    workers: int = Field(0, ge=0, description="number of workers with a recent heartbeat, except quarantined ones")


class Worker(WorkerView):
    """Worker and its present task."""

    stage: Stage | None = Field(None, description="stage of the current task")
    lease_age_s: float | None = Field(None, description="time since its last heartbeat [s]; null once it is gone")


def stage_state(stage: StageProgress) -> State:
    """Return the state of a stage from the states of its tasks."""
    if stage.succeeded == stage.tasks:
        return State.SUCCEEDED
    known = (state for state in (State.RUNNING, State.FAILED, State.CANCELLED) if getattr(stage, state))
    return next(known, State.RUNNING if stage.succeeded else State.QUEUED)


STAGE_LABELS: dict[Stage, str] = {
    Stage.SYNTHESIZE: "Synthesize",
    Stage.SCENE: "Scene",
    Stage.RENDER: "Render",
    Stage.EPISODE: "Episode",
    Stage.INGEST: "Check",
}
