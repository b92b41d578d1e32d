"""Jobs and grasps in scenes over HTTP."""

from __future__ import annotations

from starlette.testclient import TestClient

from graspd.service.pipeline.backends import Services
from tests.api.factories import add_job, finish_all

JOB = {"hand": "allegro", "object": "mug", "grasps": 32}


def test_a_job_in_a_scene_tells_its_stages_and_its_scene(http: TestClient) -> None:
    answer = http.post("/v1/jobs", json={**JOB, "scene": "table", "views": 1})
    assert answer.status_code == 202
    job = answer.json()
    assert [stage["stage"] for stage in job["stages"]] == ["scene", "synthesize", "render"]
    assert (job["request"]["scene"], job["request"]["scenes"]) == ("table", 4)
    supports = [{"kind": "half_space", "normal": [0, 0, 1], "offset": 0}]
    document = {"supports": supports, "target": [0, 0, 0.1, 1, 0, 0, 0]}
    assert http.post("/v1/jobs", json={**JOB, "scene": document}).json()["request"]["scene"] == document
    named = http.post("/v1/jobs", json={**JOB, "scene": "free", "faces": "drawn"}).json()
    assert http.post("/v1/jobs", json=JOB).json()["id"] == named["id"]
    assert not {"scene", "faces"} & set(named["request"])


def test_neighbours_are_named_and_come_back_with_their_digests(http: TestClient) -> None:
    block = http.get("/v1/objects/block").json()["digest"]
    job = http.post("/v1/jobs", json={**JOB, "scene": "bin", "neighbours": ["block", {"object": "bottle"}]}).json()
    assert [one["object"] for one in job["request"]["neighbours"]] == ["block", "bottle"]
    assert job["request"]["neighbours"][0]["digest"] == block
    page = http.get(f"/jobs/{job['id']}").text
    assert "in a bin with neighbours block, bottle" in page
    again = http.post("/v1/jobs", json=job["request"])
    assert again.json()["id"] == job["id"], "what was read can be sent again"
    unknown = http.post("/v1/jobs", json={**JOB, "scene": "bin", "neighbours": ["teapot"]})
    assert (unknown.status_code, unknown.headers["content-type"]) == (404, "application/problem+json")
    assert "there is no object 'teapot'" in unknown.json()["detail"]


def test_grasps_are_filtered_by_the_kind_of_their_scene(http: TestClient, services: Services) -> None:
    for fields in ({}, {"scene": "table", "scenes": 2}):
        finish_all(services, add_job(services, **fields))
    for kind, counts in (("free", {"free"}), ("table", {"table"}), ("any", {"table"}), ("bin", set())):
        found = http.get("/v1/grasps", params={"scene": kind, "limit": 100}).json()["items"]
        assert {grasp["scene_kind"] for grasp in found} == counts
    assert http.get("/v1/grasps", params={"scene": "moon"}).status_code == 422
    assert http.get("/v1/grasps", params={"min_clearance_m": 0.001, "lift_hard": "true"}).json()["items"] == []


def test_the_form_asks_for_a_scene_and_neighbours(http: TestClient) -> None:
    form = {"hand": "allegro", "object": "mug", "grasps": "32", "fidelity": "draft", "scene": "bin", "faces": "all"}
    answer = http.post("/submit", data=form | {"neighbours": "block, bottle block"}, follow_redirects=False)
    assert answer.status_code == 303
    told = http.get("/v1" + answer.headers["location"]).json()["request"]
    assert [one["object"] for one in told["neighbours"]] == ["block", "bottle", "block"]
    assert (told["scene"], told["faces"], told["scenes"]) == ("bin", "all", 4)
    page = http.post("/submit", data=form | {"scene": "free", "faces": "drawn", "neighbours": "block"})
    assert page.status_code == 422 and "neighbours need a scene" in page.text
    assert 'value="block"' in page.text, "what was typed stays"
    assert http.post("/submit", data=form | {"neighbours": "teapot"}).status_code == 404
