"""Cost estimate of a dataset as a document; it imports no index, so clients can read it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from graspd.service.index.views import View
from graspd.service.model.states import Stage


class WorkersPlan(View):
    """Time and network traffic of the dataset with a number of workers."""

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
        "valid", description="kind of grasps that `valid` counts: feasible ones without validation"
    )
    tasks: int
    seconds: float
    seconds_low: float = Field(description="lower end of the interval of `seconds` [s]")
    seconds_high: float = Field(description="upper end of the interval of `seconds` [s]")
    machine_factor: float | None = Field(
        description="factor on all seconds: ratio of this machine's times to the stored times; None: not measured"
    )
    seconds_by_stage: dict[Stage, float]
    seconds_per_valid: float | None
    storage_bytes: int
    storage_by_kind: dict[str, int]
    plans: list[WorkersPlan]
    rates: list[RateUsed] = Field(description="rates of the estimate, sorted by number of cells; a long list is cut")
    measured_share: float = Field(description="share of the cells with a rate measured here")
    unknown: list[str] = Field(description="hands and objects unknown to the service")
