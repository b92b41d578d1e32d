"""`/v1/jobs`: submit, list, watch, cancel, retry."""

from collections import Counter

import numpy as np
import pytest
from starlette.testclient import TestClient

from graspd.client.client import parse_events
from graspd.service.model.clock import timestamp
from graspd.service.model.metrics import GraspType
from graspd.service.model.planning import plan_tasks
from graspd.service.pipeline.backends import Services
from graspd.service.store.records import publish_record
from tests.api.factories import add_job, fail, finish, finish_all
from tests.service.pipeline.test_fidelity_choice import scene_chart
from tests.waiting import until

JOB = {"hand": "allegro", "object": "mug", "grasps": 64, "scenes": 1, "views": 1}
PAIR = {"hand": "allegro", "object": "mug", "grasps": 32}


def test_a_submitted_job_has_an_address_and_is_one_job(http: TestClient) -> None:
    answer = http.post("/v1/jobs", json=JOB)
    assert answer.status_code == 202 and answer.headers["location"] == f"/v1/jobs/{answer.json()['id']}"
    assert int(answer.headers["retry-after"]) > 0
    job = http.get(answer.headers["location"]).json()
    assert job["state"] == "queued"
    tasks = {stage["stage"]: stage["tasks"] for stage in job["stages"]}
    assert list(tasks.items()) == [("synthesize", 2), ("scene", 2), ("render", 2)]
    assert http.post("/v1/jobs", json=JOB).json()["id"] == job["id"]
    assert len(http.get("/v1/jobs").json()["items"]) == 1


def test_a_job_in_a_scene_with_auto_says_how_it_was_chosen(http: TestClient, services: Services) -> None:
    """Also where the job was there by its fidelity before."""
    scene = {**JOB, "views": 0, "scene": "table"}
    wanted = scene | {"fidelity": "auto", "target": "lift>=0.8"}
    refused = http.post("/v1/jobs", json=wanted)
    assert refused.status_code == 422 and "graspd chart --scene table --publish" in refused.text
    key = publish_record(services.store, "scene_charts/table", scene_chart())
    answer = http.post("/v1/jobs", json=wanted)
    choice = {"target": "lift>=0.8", "chart": key, "measured_on": "hand and object", "reached": 0.85}
    for job in (answer.json(), http.get(answer.headers["location"]).json()):
        assert (job["fidelity"], job["request"]["target"], job["choice"]) == ("standard", "", choice)
    page = http.get(f"/jobs/{answer.json()['id']}").text
    assert "Fidelity standard, chosen for lift&gt;=0.8, reached 0.85 with the same hand and object" in page
    named = http.post("/v1/jobs", json=scene | {"fidelity": "fine"}).json()
    chosen = http.post("/v1/jobs", json=scene | {"fidelity": "auto", "target": "lift>=0.9"}).json()
    assert (named["id"], named["choice"], chosen["choice"]["reached"]) == (chosen["id"], None, 0.95)


def test_a_finished_job_is_found_again_with_counts_and_means(http: TestClient, services: Services) -> None:
    record = add_job(services, grasps=40, scenes=2, views=3, stereo=True)
    add_job(services, seed=2)
    manifests = finish_all(services, record)
    again = http.post("/v1/jobs", json=record.request.model_dump(mode="json"))
    assert (again.status_code, again.json()["id"]) == (200, record.id)
    assert [job["id"] for job in http.get("/v1/jobs?state=succeeded").json()["items"]] == [record.id]
    job = http.get(f"/v1/jobs/{record.id}").json()
    grasps = [grasp for manifest in manifests for grasp in manifest.grasps]
    valid = [grasp for grasp in grasps if grasp.valid]
    assert (job["state"], job["grasps"], job["valid"], job["progress"]) == ("succeeded", 40, len(valid), 1.0)
    assert job["mean"]["epsilon"] == pytest.approx(sum(grasp.epsilon or 0 for grasp in valid) / len(valid))
    assert {shard["id"] for shard in job["shards"]} == {manifest.shard_id for manifest in manifests}


def test_a_finished_job_says_how_different_its_grasps_are(http: TestClient, services: Services) -> None:
    record = add_job(services, grasps=40)
    manifests = finish_all(services, record)
    found = http.get(f"/v1/jobs/{record.id}").json()["diversity"]
    valid = [grasp for manifest in manifests for grasp in manifest.grasps if grasp.valid]
    types = Counter(GraspType(grasp.grasp_type).name.lower() for grasp in valid)
    cells = Counter(grasp.approach_cell for grasp in valid)
    assert found["types"] == dict(types) and found["grasps"] == len(valid)
    assert found["directions_used"] == len(cells) and found["directions"] == 48
    shares = np.array(list(cells.values())) / len(valid)
    assert found["direction_entropy_bits"] == pytest.approx(-(shares * np.log2(shares)).sum(), abs=1e-4)
    page = http.get("/v1/grasps", params={"job": record.id, "type": "power", "valid": True, "limit": 200}).json()
    assert len(page["items"]) == types["power"] and {one["grasp_type"] for one in page["items"]} == {1}


def test_a_failed_job_keeps_its_reason_and_its_attempts(http: TestClient, services: Services) -> None:
    fail(services, record := add_job(services), "the mesh is not watertight")
    job = http.get(f"/v1/jobs/{record.id}").json()
    assert (job["state"], job["reason"]) == ("failed", "the mesh is not watertight")
    assert [(attempt["number"], attempt["last"]) for attempt in job["attempts"]] == [(1, True)]


def test_pages_of_jobs_meet_without_gap_or_overlap(http: TestClient, services: Services) -> None:
    ids = [add_job(services, seed=seed).id for seed in range(5)]
    seen, path = [], "/v1/jobs?limit=2"
    while path:
        answer = http.get(path)
        seen += [job["id"] for job in answer.json()["items"]]
        path = answer.links["next"]["url"] if "next" in answer.links else ""
    assert seen == ids[::-1]


def test_events_of_a_finished_job_say_its_end(http: TestClient, services: Services) -> None:
    record = add_job(services)
    finish_all(services, record)
    with http.stream("GET", f"/v1/jobs/{record.id}/events") as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        events = list(parse_events(answer))
    assert [name for name, _ in events] == ["progress", "end"]
    assert events[-1][1]["state"] == "succeeded"
    answer = http.get("/v1/jobs/none/events")
    assert (answer.status_code, answer.headers["content-type"]) == (404, "application/problem+json")


def test_time_that_another_job_spent_is_not_counted_twice(http: TestClient, services: Services) -> None:
    first = add_job(services, seed=7)
    made = finish_all(services, first)
    until(lambda: timestamp() > made[0].created, "the clock moves on")
    second = add_job(services, seed=7, grasps=64)
    (stage,) = http.get(f"/v1/jobs/{second.id}").json()["stages"]
    assert (stage["succeeded"], stage["reused"], stage["seconds"]) == (1, 1, 0.0)
    finish(services, second, list(plan_tasks(second))[1])
    (stage,) = http.get(f"/v1/jobs/{second.id}").json()["stages"]
    assert (stage["succeeded"], stage["reused"], stage["seconds"]) == (2, 1, 12.5)
    assert http.get(f"/v1/jobs/{first.id}").json()["stages"][0]["seconds"] == 12.5
    assert "12 s, 1 reused" in http.get(f"/jobs/{second.id}").text
    assert "none, reused" in http.get(f"/jobs/{add_job(services, seed=7, scenes=1).id}").text


def test_a_job_in_a_scene_tells_its_stages_and_its_scene(http: TestClient) -> None:
    answer = http.post("/v1/jobs", json={**PAIR, "scene": "table", "views": 1})
    assert answer.status_code == 202
    job = answer.json()
    assert [stage["stage"] for stage in job["stages"]] == ["scene", "synthesize", "render"]
    assert (job["request"]["scene"], job["request"]["scenes"]) == ("table", 4)
    supports = [{"kind": "half_space", "normal": [0, 0, 1], "offset": 0}]
    document = {"supports": supports, "target": [0, 0, 0.1, 1, 0, 0, 0]}
    assert http.post("/v1/jobs", json={**PAIR, "scene": document}).json()["request"]["scene"] == document
    named = http.post("/v1/jobs", json={**PAIR, "scene": "free", "faces": "drawn"}).json()
    assert http.post("/v1/jobs", json=PAIR).json()["id"] == named["id"]
    assert not {"scene", "faces"} & set(named["request"])


def test_neighbours_are_named_and_come_back_with_their_digests(http: TestClient) -> None:
    block = http.get("/v1/objects/block").json()["digest"]
    job = http.post("/v1/jobs", json={**PAIR, "scene": "bin", "neighbours": ["block", {"object": "bottle"}]}).json()
    assert [one["object"] for one in job["request"]["neighbours"]] == ["block", "bottle"]
    assert job["request"]["neighbours"][0]["digest"] == block
    page = http.get(f"/jobs/{job['id']}").text
    assert "in a bin with neighbours block, bottle" in page
    again = http.post("/v1/jobs", json=job["request"])
    assert again.json()["id"] == job["id"], "what was read can be sent again"
    unknown = http.post("/v1/jobs", json={**PAIR, "scene": "bin", "neighbours": ["teapot"]})
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
