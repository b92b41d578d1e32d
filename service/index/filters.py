"""What grasps may be filtered and sorted by."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from service.model.base import Model
from service.model.metric_fields import SortedName

Metric = SortedName


class GraspFilter(Model):
    """All conditions hold at once. `at_least` and `at_most` bound metrics, inclusive; a missing value never matches."""

    hand: str | None = None
    object: str | None = None
    job: str | None = None
    shard: str | None = None
    dataset: str | None = None
    """Of its cells."""
    tag: str | None = None
    """Id of a tag that they have."""
    where: str | None = None
    """An expression of `service.model.where`."""
    project: str | None = None
    """Of whose jobs; None: of everybody's."""
    judged: bool | None = None
    """Whether the referee gave a verdict."""
    valid: bool | None = None
    """False: judged, and not valid."""
    success: bool | None = None
    scene: str | None = None
    """Kind of the scene that it was planned in; any: whichever, but not free."""
    neighbours: bool | None = None
    """Whether other objects stood in that scene."""
    lift_hard: bool | None = None
    robust_weakest: str | None = None
    """Axis of the first model in which it does not hold."""
    at_least: dict[Metric, float] = Field(default_factory=dict)
    at_most: dict[Metric, float] = Field(default_factory=dict)


class GraspSort(Model):
    """Order of grasps; those without the metric come last."""

    by: Metric | Literal["created"] = "epsilon"
    descending: bool = True
