"""Cost estimate of a dataset as a document; it imports no index, so clients can read it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from graspd.service.index.views import View
from graspd.service.model.states import Stage


class WorkersPlan(View):
    """The same dataset on a number of workers."""

    workers: int
    seconds: float = Field(description="expected time until the dataset is done [s]")
    seconds_low: float = Field(description="the same if all goes quickly [s]")
    seconds_high: float = Field(description="the same if all goes slowly [s]")
    network_bytes: int = Field(description="between workers, store and Redis, if these are other machines")
    network_bytes_per_s: float = Field(description="the same, on average over that time")


class RateUsed(View):
    """A rate of the estimate, and the number of cells that use it."""

    hand: str
    cells: int
    seconds_per_valid: float | None = Field(description="None: no try is expected to give a valid grasp")
    seconds_per_try: float
    valid_yield: float
    origin: str
    batches: int = Field(description="finished batches it was measured on; 0: a stored default")


class Estimate(View):
    """Estimated cost of a dataset. Seconds are of one worker."""

    cells: int
    asked: int = Field(description="grasps asked for, over all cells")
    candidates: int = Field(description="grasps to be computed for these")
    valid: int = Field(description="grasps to be expected of the standing in `counted`")
    counted: Literal["valid", "feasible"] = Field(
        "valid", description="what `valid` counts: feasible ones if nothing is validated"
    )
    tasks: int
    seconds: float
    seconds_low: float = Field(description="lower end of the interval of `seconds` [s]")
    seconds_high: float = Field(description="its upper end [s]")
    machine_factor: float | None = Field(
        description="this machine's seconds over the stored ones, which scales these; None: nothing was measured here"
    )
    seconds_by_stage: dict[Stage, float]
    seconds_per_valid: float | None
    storage_bytes: int
    storage_by_kind: dict[str, int]
    plans: list[WorkersPlan]
    rates: list[RateUsed] = Field(description="the first of them, those of most cells first")
    measured_share: float = Field(description="share of the cells with a rate that was measured here")
    unknown: list[str] = Field(description="hands and objects that the service does not know yet")
