"""Estimates and datasets on a terminal."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from graspd.client.reports import print_cells, print_dataset, print_estimate
from graspd.service.model.domain import JobOptions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.cost import estimate
from graspd.service.pipeline.datasets.spec import DatasetRequest
from tests.api.factories import add_job, finish_all
from tests.planning import plan_all


@pytest.mark.parametrize("validation", ["none", "standard"])
def test_a_report_names_the_standing_of_what_it_counts(services: Services, validation: str) -> None:
    given = {"name": "k", "hands": ["allegro"], "objects": ["mug"], "grasps": 32, "validation": validation}
    wanted = DatasetRequest.model_validate(given)
    actions.create(services, wanted)
    plan_all(services)
    finish_all(services, add_job(services, validation=validation))
    out = io.StringIO()
    console = Console(file=out, width=200)
    dataset = services.index.datasets.get("k")
    print_estimate(estimate(services.index, wanted), console)
    print_dataset(dataset, console)
    print_cells(dataset, services.index.datasets.cells("k").items, console)
    made = 32 if validation == "none" else dataset.valid
    word, other = ("feasible", "valid") if validation == "none" else ("valid", "feasible")
    assert f"grasps: {made} {word} of 32 candidates" in out.getvalue()
    validated = "not validated" if validation == "none" else "at"
    assert f"per {word} grasp" in out.getvalue() and f"{made}/32 {validated}" in out.getvalue()
    assert other not in out.getvalue()


def test_candidate_grasps_that_nobody_judges_are_merely_kept() -> None:
    assert JobOptions(want="candidates", validation="none").standing == "kept"
