"""Two datasets side by side: settings that differ, cells, distributions in the same bins."""

from __future__ import annotations

import pytest
from starlette.testclient import TestClient

from graspd.api.catalog.datasets import Datasets, Pair
from graspd.service.index.queries.grasps import GraspFilter
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from tests.api.factories import add_job, finish_all
from tests.fakes import plan_all


def _two(services: Services) -> None:
    """`rough` is done, one cell of draft grasps; `fine` has another object besides and no grasp yet."""
    rough = {"name": "rough", "hands": ["allegro"], "objects": ["mug"], "grasps": 32, "fidelity": "draft"}
    fine = {"name": "fine", "hands": ["allegro"], "objects": ["mug", "block"], "grasps": 32}
    for given in (rough, fine):
        actions.create(services, DatasetRequest.model_validate(given))
    plan_all(services)
    finish_all(services, add_job(services, fidelity="draft"))


def test_the_page_shows_what_differs_and_every_cell(http: TestClient, services: Services) -> None:
    _two(services)
    page = " ".join(http.get("/compare", params={"one": "rough", "other": "fine"}).text.split())
    assert "Fidelity</th><td" in page and ">draft</td>" in page and ">standard</td>" in page
    assert "Objects of its own</th>" in page and ">block</td>" in page
    assert page.count("<td>allegro</td>") == 2
    assert page.count('<figure class="card histo twin">') > 3
    assert "options are the same" not in page


def test_a_dataset_beside_itself_differs_in_nothing(http: TestClient, services: Services) -> None:
    _two(services)
    page = http.get("/compare", params={"one": "rough", "other": "rough"}).text
    assert "options are the same" in page and "+0 points" in page
    assert "No grasp yet" in http.get("/compare", params={"one": "fine", "other": "fine"}).text
    assert http.get("/compare", params={"one": "rough", "other": "gone"}).status_code == 404
    page = http.get("/compare").text
    assert page.count("<option>rough</option>") == page.count("<option>fine</option>") == 2
    assert "/compare?one=rough&amp;other=fine" in http.get("/datasets").text


def test_distributions_of_two_share_their_bins_and_count_all(services: Services) -> None:
    _two(services)
    filters = [GraspFilter(dataset="rough", valid=valid) for valid in (True, False, None)]
    one, other, both = services.index.statistics.side_by_side(filters, ["epsilon"], bins=7)["epsilon"]
    assert one is not None and other is not None and both is not None
    assert (one.low, one.high) == (other.low, other.high)
    assert [a + b for a, b in zip(one.counts, other.counts, strict=True)] == both.counts


def test_more_cells_than_anybody_reads_are_left_out(services: Services, monkeypatch: pytest.MonkeyPatch) -> None:
    _two(services)
    monkeypatch.setattr("graspd.api.catalog.datasets.MOST_CELLS", 1)
    datasets = Datasets(services, None)  # type: ignore[arg-type]
    assert datasets.compare("rough", "fine").pairs == [] and Pair("hand", "object", None, None).gain is None
