"""Valid yield is of what somebody validated: grasps that are not validated are no failures, in no number and on no
page."""

from __future__ import annotations

import pytest
from starlette.testclient import TestClient

from graspd.service.pipeline.backends import Services
from tests.api.factories import add_job, finish_all


@pytest.fixture
def jobs(http: TestClient, services: Services) -> dict[str, str]:
    """One job that was validated, and a larger one on the same pair that was not."""
    validated, unvalidated = (
        add_job(services, want="candidates"),
        add_job(services, grasps=320, validation="none", want="candidates"),
    )
    for record in (validated, unvalidated):
        finish_all(services, record)
    return {"validated": validated.id, "unvalidated": unvalidated.id}


def share(http: TestClient, job: str) -> float:
    rows = http.get("/v1/grasps", params={"job": job, "limit": 200}).json()["items"]
    return sum(row["valid"] for row in rows) / len(rows)


def test_service_and_job_count_as_tries_only_what_was_validated(http: TestClient, jobs: dict[str, str]) -> None:
    stats = http.get("/v1/stats").json()
    assert (stats["candidates"], stats["validated"]) == (352, 32)
    told = {name: http.get(f"/v1/jobs/{job}").json() for name, job in jobs.items()}
    assert stats["valid_yield"] == told["validated"]["valid_yield"] == share(http, jobs["validated"])
    assert (told["unvalidated"]["validated"], told["unvalidated"]["valid_yield"]) == (0, None)
    words = f"{int(100 * share(http, jobs['validated']) + 1e-9)} %"
    home = http.get("/").text
    assert words in home and "320 candidates not validated" in home
    assert words in http.get("/datasets").text


def test_unjudged_grasps_are_not_among_the_rejected(http: TestClient, jobs: dict[str, str]) -> None:
    def found(**query: str) -> set[str]:
        rows = http.get("/v1/grasps", params={"limit": 200, **query}).json()["items"]
        assert rows
        return {str(row["success"]) for row in rows}

    rejected = http.get("/v1/grasps", params={"limit": 200, "valid": "false"}).json()["items"]
    assert rejected and all(row["success"] is False for row in rejected)
    assert found(validated="false") == found(where="not validated") == {"None"}
    assert "None" not in found(validated="true") | found(where="validated and not valid")
