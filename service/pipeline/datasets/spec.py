"""Models of datasets: request, record and cost estimate. For clients, no database is imported."""

from collections.abc import Callable, Sequence
from typing import Annotated, Final, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from graspd.service.index.views import View
from graspd.service.model.base import Name
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_json, job_id
from graspd.service.model.domain import JobOptions, JobRequest
from graspd.service.model.fidelity import AUTO
from graspd.service.model.records import DatasetMember, DatasetRecord, FidelityChoice, create_job_request
from graspd.service.model.renamed import original_request
from graspd.service.model.states import Stage
from graspd.service.model.version import STAGE_REVISIONS

#: Maximum number of cells of a dataset, whose record then has 4 MB.
MAX_CELLS: Final = 100_000
#: Names without repetitions.
Names = Annotated[tuple[Name, ...], AfterValidator(lambda given: tuple(dict.fromkeys(given)))]


class Matrix(JobOptions):
    """Hands x objects, and the options of each cell; `grasps` is the number per cell."""

    SUBMITTED = True

    hands: Names = Field(min_length=1, max_length=1000, description="names of hands")
    objects: Names = Field((), max_length=MAX_CELLS, description="names of objects")
    sets: Names = Field((), max_length=100, description="names of object sets, added after `objects`")

    @model_validator(mode="after")
    def _require_objects(self) -> Self:
        if not self.objects and not self.sets:
            raise ValueError("a dataset needs objects: name objects, or a set of objects")
        return self

    @property
    def cell_options(self) -> JobOptions:
        return JobOptions(**{name: getattr(self, name) for name in JobOptions.model_fields})


class DatasetRequest(Matrix):
    name: Name = Field(description="name of the dataset; `estimate` is reserved")

    @field_validator("name")
    @classmethod
    def _refuse_reserved_name(cls, value: str) -> str:
        if value == "estimate":
            raise ValueError("this name is reserved for estimates; choose another one")
        return value


def create_record(
    name: str,
    hands: Sequence[DatasetMember],
    objects: Sequence[DatasetMember],
    options: JobOptions,
    choose: Callable[[JobRequest], tuple[JobRequest, FidelityChoice | None]],
    owner: str = "",
    project: str = "",
) -> DatasetRecord:
    """Return the record of a dataset; its digest depends on hands, objects, options and fidelities.

    `choose` replaces the fidelity `auto` of a cell, or raises InputError if none meets the target.
    """
    cells = [
        (hand, obj, *choose(create_job_request(options, hand.name, obj.name))) for hand in hands for obj in objects
    ]
    fidelities = tuple(str(request.fidelity) for _, _, request, _ in cells) if options.fidelity == AUTO else ()
    found = [choice for *_, choice in cells if choice is not None]
    places = {choice: place for place, choice in enumerate(dict.fromkeys(found))}
    # Unused newer options are omitted, so that digests of older datasets stay.
    unused = {name for name in ("options", "target") if not getattr(options, name)}
    content = {
        "hands": [[hand.name, hand.digest] for hand in hands],
        "objects": [[obj.name, obj.digest] for obj in objects],
        "options": original_request(options.model_dump(mode="json", exclude=unused)),
        **({"fidelities": fidelities} if fidelities else {}),
    }
    return DatasetRecord(
        name=name,
        digest=digest_json(content),
        hands=tuple(hands),
        objects=tuple(objects),
        options=options,
        revisions=dict(STAGE_REVISIONS),
        jobs=tuple(job_id(request, hand.digest, obj.digest, project) for hand, obj, request, _ in cells),
        fidelities=fidelities,
        choices=tuple(places),
        chosen=tuple(places[choice] for choice in found),
        created=timestamp(),
        owner=owner,
        project=project,
    )


class WorkersPlan(View):
    """Time and network traffic of a dataset with `workers` workers."""

    workers: int
    seconds: float = Field(description="expected time until the dataset is done [s]")
    seconds_low: float = Field(description="lower end of the interval of `seconds` [s]")
    seconds_high: float = Field(description="upper end of the interval of `seconds` [s]")
    network_bytes: int = Field(description="traffic between workers, store and Redis, if on different machines")
    network_bytes_per_s: float = Field(description="average of `network_bytes` over `seconds`")


class RateUsed(View):
    """A rate of the estimate, and the number of cells that use it."""

    hand: str
    cells: int
    seconds_per_valid: float | None = Field(description="None: no candidate is expected to be valid")
    seconds_per_try: float
    valid_yield: float
    origin: str
    batches: int = Field(description="finished batches on which it was measured; 0: a stored default")


class Estimate(View):
    cells: int
    asked: int = Field(description="grasps requested in all cells")
    candidates: int = Field(description="candidates to plan for the requested grasps")
    valid: int = Field(description="expected number of grasps of the kind in `counted`")
    counted: Literal["valid", "feasible"] = Field(
        "valid", description="kind of grasps that `valid` counts: valid, or feasible without validation"
    )
    tasks: int
    seconds: float
    seconds_low: float = Field(description="lower end of the interval of `seconds` [s]")
    seconds_high: float = Field(description="upper end of the interval of `seconds` [s]")
    machine_factor: float | None = Field(description="seconds on this machine / stored seconds; None: not measured")
    seconds_by_stage: dict[Stage, float]
    seconds_per_valid: float | None
    storage_bytes: int
    storage_by_kind: dict[str, int]
    plans: list[WorkersPlan]
    rates: list[RateUsed] = Field(description="rates of the estimate, sorted by number of cells; a long list is cut")
    measured_share: float = Field(description="share of the cells with a rate measured here")
    unknown: list[str] = Field(description="hands and objects unknown to the service")
