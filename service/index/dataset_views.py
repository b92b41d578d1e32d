"""What the index answers on datasets. Times are RFC 3339 in UTC."""

from __future__ import annotations

from pydantic import Field, computed_field

from service.index.views import Judged, View
from service.model.domain import JobOptions
from service.model.outcomes import shortfall
from service.model.records import Choice
from service.model.states import State


class DatasetView(Judged):
    """A dataset in numbers. `grasps`, `valid` and `tried` count what base shards hold so far."""

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
        """Says so where a dataset ended with fewer grasps than it was asked for."""
        if not self.state.is_final or self.options.want != "valid":
            return None
        options = self.options
        return shortfall(self.counted, self.asked, options.counted, self.tried, options.budget, self.outcomes)

    @property
    def counted(self) -> int:
        """Grasps of the standing that its options can give."""
        return self.valid if self.options.standing == "valid" else self.grasps


class CellView(Judged):
    """One hand x object of a dataset: an ordinary job, or one that is still to be planned."""

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
        """Grasps of the standing that its dataset's options can give."""
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
        """Grasps of the standing that its dataset's options can give."""
        return self.valid if options.standing == "valid" else self.grasps


class ObjectSetView(View):
    """The newest version of a named set of objects."""

    name: str
    digest: str
    objects: list[str]
    created: str
    project: str = Field("", description="project that it belongs to; empty: the one without a name")
