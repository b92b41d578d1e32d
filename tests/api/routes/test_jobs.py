"""`/v1/jobs`, `/v1/datasets` and `/v1/object-sets`: submit, list, watch, cancel, retry, refusals."""

from collections import Counter
from typing import Any

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
from tests.fakes import plan_all, record_of
from tests.service.pipeline.test_fidelity_choice import CHART, scene_chart
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
    assert refused.status_code == 422 and "benchmarks.scenes_chart --scene table --publish" in refused.text
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
    assert "in a bin with neighbours block, bottle" in http.get(f"/jobs/{job['id']}").text
    assert http.post("/v1/jobs", json=job["request"]).json()["id"] == job["id"], "what was read can be sent again"
    unknown = http.post("/v1/jobs", json={**PAIR, "scene": "bin", "neighbours": ["teapot"]})
    assert (unknown.status_code, unknown.headers["content-type"]) == (404, "application/problem+json")
    assert "there is no object 'teapot'" in unknown.json()["detail"]


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


WANTED = {"name": "kitchen", "hands": ["allegro", "barrett"], "objects": ["mug", "block"], "grasps": 64}


@pytest.fixture
def kitchen(http: TestClient) -> dict[str, Any]:
    answer = http.post("/v1/datasets", json=WANTED)
    assert answer.status_code == 202
    return answer.json()


def finish_cells(services: Services, http: TestClient, count: int) -> None:
    plan_all(services)
    for cell in http.get("/v1/datasets/kitchen/cells").json()["items"][:count]:
        finish_all(services, record_of(services, cell["job_id"]))


def test_a_new_dataset_has_a_place_and_a_done_one_is_found(http: TestClient, services: Services) -> None:
    answer = http.post("/v1/datasets", json=WANTED)
    assert answer.status_code == 202
    assert answer.headers["Location"] == "/v1/datasets/kitchen" and answer.headers["Retry-After"] == "1"
    dataset = http.get("/v1/datasets/kitchen").json()
    assert dataset == answer.json()
    assert (dataset["cells"], dataset["state"], dataset["asked"]) == (4, "queued", 256)
    assert [one["name"] for one in http.get("/v1/datasets").json()["items"]] == ["kitchen"]
    finish_cells(services, http, 4)
    again = http.post("/v1/datasets", json=WANTED)
    assert again.status_code == 200 and again.json()["state"] == "succeeded"


def test_with_auto_each_cell_says_which_fidelity_it_got(http: TestClient, services: Services) -> None:
    wanted = WANTED | {"fidelity": "auto", "target": "gsr>=0.6"}
    unnamed = {key: value for key, value in wanted.items() if key != "name"}
    for path, body in (("/v1/datasets", wanted), ("/v1/datasets/estimate", unnamed)):
        answer = http.post(path, json=body)
        assert answer.status_code == 422 and "graspd chart --publish" in answer.text
    publish_record(services.store, "charts", CHART)
    assert http.post("/v1/datasets", json=wanted).status_code == 202
    cells = http.get("/v1/datasets/kitchen/cells").json()["items"]
    assert {(cell["hand"], cell["fidelity"]) for cell in cells} == {("allegro", "standard"), ("barrett", "draft")}
    assert "auto (gsr&gt;=0.6)" in http.get("/datasets/kitchen").text


def test_cells_come_in_pages_with_a_next_link(http: TestClient, services: Services, kitchen: dict[str, Any]) -> None:
    finish_cells(services, http, 1)
    first = http.get("/v1/datasets/kitchen/cells", params={"limit": 3})
    address = first.headers["Link"].partition(">")[0].lstrip("<")
    cells = first.json()["items"] + http.get(address).json()["items"]
    pairs = [(cell["hand"], cell["object"]) for cell in cells]
    assert pairs == [("allegro", "mug"), ("allegro", "block"), ("barrett", "mug"), ("barrett", "block")]
    assert [cell["state"] for cell in cells] == ["succeeded", "queued", "queued", "queued"]
    done = http.get("/v1/datasets/kitchen/cells", params={"state": "succeeded"}).json()["items"]
    assert [cell["position"] for cell in done] == [0]


def test_what_cannot_be_made_is_refused(http: TestClient) -> None:
    for changes, status, words in (
        ({"hands": ["foot"]}, 404, "there is no hand 'foot'"),
        ({"objects": []}, 422, "needs objects"),
        ({"views": 2}, 422, "views need scenes"),
        ({"scene": "bin", "neighbours": ["teapot"]}, 404, "there is no object 'teapot'"),
        ({"name": "../etc"}, 422, "name"),
        ({"colour": "red"}, 422, "colour"),
    ):
        answer = http.post("/v1/datasets", json=WANTED | changes)
        assert answer.status_code == status and words in answer.json()["detail"]
    assert http.get("/v1/datasets").json()["items"] == []


def test_an_estimate_records_nothing(http: TestClient) -> None:
    matrix = {key: value for key, value in WANTED.items() if key != "name"}
    found = http.post("/v1/datasets/estimate", json=matrix | {"grasps": 1_000_000, "scenes": 1}).json()
    assert found["asked"] == 4_000_000 and [plan["workers"] for plan in found["plans"]] == [1, 8, 64]
    assert all(rate["origin"].startswith("stored default") for rate in found["rates"])
    assert http.get("/v1/datasets").json()["items"] == []


def test_a_snapshot_is_made_once_with_checksums(http: TestClient, services: Services, kitchen: dict[str, Any]) -> None:
    assert http.post("/v1/datasets/kitchen/snapshots").status_code == 409
    finish_cells(services, http, 2)
    taken = http.post("/v1/datasets/kitchen/snapshots")
    assert taken.status_code == 201 and taken.json()["shards"] == 4 and not taken.json()["complete"]
    assert http.post("/v1/datasets/kitchen/snapshots").status_code == 200
    assert http.get("/v1/datasets/kitchen/snapshots").json()["items"] == [taken.json()]
    whole = http.get(taken.headers["Location"]).json()
    for shard in whole["shards"]:
        assert shard["sha256"] == http.get(f"/v1/shards/{shard['id']}").json()["sha256"]


def test_objects_get_a_name_together_and_make_a_dataset(http: TestClient) -> None:
    answer = http.post("/v1/object-sets", json={"name": "all", "objects": ["mug", "bottle", "block"]})
    assert answer.status_code == 201 and answer.headers["Location"] == "/v1/object-sets/all"
    assert http.get("/v1/object-sets").json() == [http.get("/v1/object-sets/all").json()]
    dataset = http.post("/v1/datasets", json={"name": "d", "hands": ["allegro"], "sets": ["all"]}).json()
    assert dataset["objects"] == ["block", "bottle", "mug"]
    assert http.post("/v1/object-sets", json={"name": "all", "objects": ["moon"]}).status_code == 404
    assert http.get("/v1/object-sets/none").status_code == 404
