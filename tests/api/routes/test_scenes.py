"""Jobs and grasps in scenes over HTTP."""

from __future__ import annotations

from typing import Any

import pytest
from starlette.testclient import TestClient

from service.pipeline.backends import Parts
from tests.api.factories import add_job, finish_all

JOB = {"hand": "allegro", "object": "mug", "grasps": 32}
PLANE = {"kind": "half_space"}


def test_a_job_in_a_scene_tells_its_stages_and_its_scene(http: TestClient) -> None:
    answer = http.post("/v1/jobs", json={**JOB, "scene": "table", "views": 1})
    assert answer.status_code == 202
    job = answer.json()
    assert [stage["stage"] for stage in job["stages"]] == ["scene", "synthesize", "render"]
    assert (job["request"]["scene"], job["request"]["scenes"]) == ("table", 4)


def test_a_document_comes_back_as_it_was_sent(http: TestClient) -> None:
    document = {
        "supports": [{"kind": "half_space", "normal": [0, 0, 1], "offset": 0}],
        "target": [0, 0, 0.1, 1, 0, 0, 0],
    }
    assert http.post("/v1/jobs", json={**JOB, "scene": document}).json()["request"]["scene"] == document


def test_a_job_without_a_scene_says_nothing_of_one(http: TestClient) -> None:
    plain, named = (
        http.post("/v1/jobs", json={**JOB, **more}).json() for more in ({}, {"scene": "free", "faces": "drawn"})
    )
    assert plain["id"] == named["id"]
    assert not {"scene", "faces"} & set(plain["request"])


def test_the_document_offers_scenes_and_keeps_the_defaults(http: TestClient) -> None:
    fields = http.get("/openapi.json").json()["components"]["schemas"]["JobRequest"]["properties"]
    defaults = {name: field["default"] for name, field in fields.items() if "default" in field}
    assert defaults == {
        "grasps": 32, "method": "fast_graspd", "fidelity": "standard", "seed": 0, "scene": "free", "faces": "drawn",
        "scenes": 0, "views": 0, "stereo": False, "width": 320, "height": 240, "channels": [], "friction": 1.0,
        "want": "valid", "budget": 4.0, "referee": "certificate", "audits": 8, "robustness": 0, "target": "",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("wrong", "where", "words"),
    [
        ({"scene": "tabel"}, "scene", "'table'"),
        ({"scene": {"supports": [PLANE, {"kind": "box", "size": [0, 1, 1]}]}}, "scene", "greater than"),
        ({"scene": {"supports": [PLANE], "target": [0, 0, 0, 9, 0, 0, 0]}}, "scene", "less than"),
        ({"scene": {"supports": [PLANE] * 33}}, "scene", "at most 32"),
        ({"scene": "bin", "method": "graspit"}, "body", "plans around free objects only"),
        ({"scene": "free", "faces": "all"}, "body", "lies on no face"),
    ],
)
def test_a_scene_that_is_none_is_a_problem(http: TestClient, wrong: dict[str, Any], where: str, words: str) -> None:
    answer = http.post("/v1/jobs", json=JOB | wrong)
    assert (answer.status_code, answer.headers["content-type"]) == (422, "application/problem+json")
    detail = answer.json()["detail"]
    assert detail.startswith(where) and words in detail and "\n" not in detail
    assert http.get("/v1/jobs").json()["items"] == []


def test_grasps_are_filtered_by_the_kind_of_their_scene(http: TestClient, parts: Parts) -> None:
    for fields in ({}, {"scene": "table", "scenes": 2}):
        finish_all(parts, add_job(parts, **fields))
    for kind, counts in (("free", {"free"}), ("table", {"table"}), ("any", {"table"}), ("bin", set())):
        found = http.get("/v1/grasps", params={"scene": kind, "limit": 100}).json()["items"]
        assert {grasp["scene_kind"] for grasp in found} == counts
    assert http.get("/v1/grasps", params={"scene": "moon"}).status_code == 422
    assert http.get("/v1/grasps", params={"min_clearance_m": 0.001, "lift_hard": "true"}).json()["items"] == []


def test_the_form_asks_for_a_scene(http: TestClient) -> None:
    form = {"hand": "allegro", "object": "mug", "grasps": "32", "fidelity": "draft", "scene": "bin", "faces": "all"}
    answer = http.post("/submit", data=form, follow_redirects=False)
    assert answer.status_code == 303
    request = http.get("/v1" + answer.headers["location"]).json()["request"]
    assert (request["scene"], request["faces"], request["scenes"]) == ("bin", "all", 4)
    page = http.post("/submit", data=form | {"scene": "free"})
    assert page.status_code == 422
    assert "lies on no face" in page.text
