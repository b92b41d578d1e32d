"""Datasets planned at once, as the controller would round by round."""

from __future__ import annotations

from service.pipeline.backends import Services
from service.pipeline.datasets.rounds import DatasetRounds


def plan_all(services: Services) -> None:
    """Rounds of the planner until nothing is left, however slow the machine."""
    planner = DatasetRounds(services)
    while planner.advance():
        pass
