"""Datasets planned at once, as the controller would round by round."""

from __future__ import annotations

import math

from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets.rounds import DatasetRounds


def plan_all(services: Services) -> None:
    """All that is left, in one round however slow the machine: cells that are planned at once share the workers."""
    assert not DatasetRounds(services).advance(math.inf)
