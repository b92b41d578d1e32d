"""Valid yield is of what somebody judged: grasps that nobody judged are no failures, in no number and on no page."""

from __future__ import annotations

import pytest
from starlette.testclient import TestClient

from service.pipeline.backends import Services
from service.pipeline.datasets import actions
from service.pipeline.datasets.spec import DatasetRequest
from tests.api.factories import add_job, finish_all
from tests.fakes import record_of
from tests.planning import plan_all


@pytest.fixture
def jobs(http: TestClient, services: Services) -> dict[str, str]:
    """One job that was judged, and a larger one on the same pair that was not."""
    judged, unjudged = add_job(services, want="raw"), add_job(services, grasps=320, referee="none", want="raw")
    for record in (judged, unjudged):
        finish_all(services, record)
    return {"judged": judged.id, "unjudged": unjudged.id}


def share(http: TestClient, job: str) -> float:
    rows = http.get("/v1/grasps", params={"job": job, "limit": 200}).json()["items"]
    return sum(row["valid"] for row in rows) / len(rows)


def test_service_and_job_count_as_tries_only_what_was_judged(http: TestClient, jobs: dict[str, str]) -> None:
    stats = http.get("/v1/stats").json()
    assert (stats["tried"], stats["judged"]) == (352, 32)
    told = {name: http.get(f"/v1/jobs/{job}").json() for name, job in jobs.items()}
    assert stats["valid_yield"] == told["judged"]["valid_yield"] == share(http, jobs["judged"])
    assert (told["unjudged"]["judged"], told["unjudged"]["valid_yield"]) == (0, None)
    words = f"{int(100 * share(http, jobs['judged']) + 1e-9)} %"
    home = http.get("/").text
    assert words in home and "320 more are not judged" in home
    assert words in http.get("/datasets").text


def test_a_dataset_of_unjudged_grasps_has_no_yield(http: TestClient, services: Services) -> None:
    wanted = {"name": "d", "hands": ["allegro"], "objects": ["mug"], "referee": "none"}
    actions.create(services, DatasetRequest.model_validate(wanted))
    plan_all(services)
    (job,) = services.index.jobs.page().items
    finish_all(services, record_of(services, job.id))
    (cell,) = http.get("/v1/datasets/d/cells").json()["items"]
    assert (cell["tried"], cell["judged"], cell["valid_yield"]) == (32, 0, None)
    assert http.get("/v1/datasets/d").json()["valid_yield"] is None
    for page in ("/datasets/d", "/datasets", "/compare?one=d&other=d", f"/jobs/{job.id}", "/"):
        assert "not judged" in http.get(page).text, page


def test_unjudged_grasps_are_not_among_the_rejected(http: TestClient, jobs: dict[str, str]) -> None:
    def found(**query: str) -> set[str]:
        rows = http.get("/v1/grasps", params={"limit": 200, **query}).json()["items"]
        assert rows
        return {str(row["success"]) for row in rows}

    rejected = http.get("/v1/grasps", params={"limit": 200, "valid": "false"}).json()["items"]
    assert rejected and all(row["success"] is False for row in rejected)
    assert found(judged="false") == found(where="not judged") == {"None"}
    assert "None" not in found(judged="true") | found(where="judged and not valid")
