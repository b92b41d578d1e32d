"""`/v1/datasets` and `/v1/object-sets`: answers, places, pages, refusals."""

from typing import Any

import pytest
from starlette.testclient import TestClient

from graspd.service.pipeline.backends import Services
from graspd.service.store.records import publish_record
from tests.api.factories import finish_all
from tests.fakes import plan_all, record_of
from tests.service.pipeline.test_fidelity_choice import CHART

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
