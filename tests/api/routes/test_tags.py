"""Tags: names for grasps, in the store and in the index; grasps chosen by an expression; what is taken home of them."""

import csv
import io
import json
import zipfile
from html import unescape
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from graspd.api.access.keys import Scope
from graspd.api.app import create_app
from graspd.service.index.rebuild import differences, rebuild
from graspd.service.model import names
from graspd.service.model.records import MOST_TAGGED
from graspd.service.pipeline.backends import Services
from graspd.service.readers.where import compile_expression
from graspd.service.store.manifests import ShardManifest
from graspd.service.store.shards import Shard, read_shard
from tests.api.factories import add_job, finish_all, people_of
from tests.fakes import plan_all

Grasps = list[dict[str, Any]]


@pytest.fixture
def made(services: Services) -> ShardManifest:
    return finish_all(services, add_job(services))[0]


def named(shard: str, *rows: int) -> Grasps:
    return [{"shard_id": shard, "row": row} for row in rows]


def give(http: TestClient, name: str, **chosen: Any) -> dict[str, Any]:
    answer = http.post("/v1/tags", json={"name": name, **chosen})
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def rows_of(http: TestClient, **query: Any) -> list[int]:
    answer = http.get("/v1/grasps", params={"limit": 200, **query})
    assert answer.status_code == 200, answer.text
    return sorted(grasp["row"] for grasp in answer.json()["items"])


def shard_of(services: Services, made: ShardManifest) -> Shard:
    return read_shard(services.store.get(made.key))


def test_a_tag_is_given_listed_filtered_by_and_taken_off(http: TestClient, made: ShardManifest) -> None:
    change = give(http, "good", grasps=named(made.shard_id, 3, 5, 8))
    assert (change["changed"], change["tag"]["grasps"]) == (3, 3)
    assert give(http, "good", grasps=named(made.shard_id, 8, 9))["changed"] == 1
    assert rows_of(http, tag="good") == [3, 5, 8, 9]
    assert http.post("/v1/tags/good/remove", json={"grasps": named(made.shard_id, 5, 6)}).json()["changed"] == 1
    assert [(tag["name"], tag["grasps"]) for tag in http.get("/v1/tags").json()] == [("good", 3)]
    assert rows_of(http, tag="good", sort="penetration_depth_mm", max_penetration_depth_mm=1e6) == [3, 8, 9]
    assert http.delete("/v1/tags/good").status_code == 204
    assert http.get("/v1/tags/good").status_code == http.get("/v1/grasps?tag=good").status_code == 404
    assert rows_of(http) == list(range(32))


def test_all_that_pass_a_filter_are_tagged(http: TestClient, made: ShardManifest, services: Services) -> None:
    give(http, "deep", filter={"where": "penetration_depth_mm > 0.8", "valid": True})
    deep = shard_of(services, made)["quality/penetration_depth_mm"] > 0.8
    valid = shard_of(services, made)["quality/valid"] == 1
    assert rows_of(http, tag="deep") == np.flatnonzero(deep & valid).tolist()


@pytest.mark.parametrize(
    "expression",
    [
        "epsilon > 0.25",
        "not (epsilon > 0.25 or contact_area_cm2 <= 8) and valid",
        "type = power or type = 'lateral' and not held",
        "hand = allegro and object != mug",
        "robust >= 0 or not robust < 1",
        "lift or lift_hard or clearance_m > -1",
    ],
)
def test_index_and_shards_agree(http: TestClient, made: ShardManifest, services: Services, expression: str) -> None:
    shard = shard_of(services, made)
    rows = np.flatnonzero(compile_expression(expression)(shard.arrays, shard.attributes)).tolist()
    assert rows_of(http, where=expression) == rows


def test_an_expression_that_cannot_be_used_is_said_so(http: TestClient) -> None:
    refused = {"__import__('os')": "no '__import__'", "valid and " * 120: "1000"}
    refused |= dict.fromkeys(("feasible", "simulated_displacement_cm > 1"), "the shards have it")
    for expression, words in refused.items():
        answer = http.get("/v1/grasps", params={"where": expression})
        assert answer.status_code == 422 and words in answer.json()["detail"]


def test_tags_survive_a_rebuild_as_in_the_store(http: TestClient, made: ShardManifest, services: Services) -> None:
    give(http, "good", grasps=named(made.shard_id, 1, 2, 3))
    give(http, "gone", grasps=named(made.shard_id, 4))
    http.post("/v1/tags/good/remove", json={"grasps": named(made.shard_id, 2)})
    http.delete("/v1/tags/gone")
    assert [line for line in differences(services.index, services.store) if line.startswith("tag")] == []
    assert [entry.key.rpartition("/")[2] for entry in services.store.list(names.TAGS)] == ["000002.json"]
    rebuild(services.index, services.store)
    assert rows_of(http, tag="good") == [1, 3]
    assert [tag["name"] for tag in http.get("/v1/tags").json()] == ["good"]


def test_a_tag_is_made_anew_after_its_end_even_if_that_broke_off(
    http: TestClient, made: ShardManifest, services: Services, monkeypatch: pytest.MonkeyPatch
) -> None:
    give(http, "good", grasps=named(made.shard_id, 1))
    monkeypatch.setattr("graspd.service.store.records.delete_older_tag_versions", lambda *_: None)
    http.delete("/v1/tags/good")
    rebuild(services.index, services.store)
    assert http.get("/v1/tags").json() == []
    assert give(http, "good", grasps=named(made.shard_id, 7))["tag"]["grasps"] == 1
    assert rows_of(http, tag="good") == [7]


def test_absent_or_too_much_gets_no_tag(http: TestClient, made: ShardManifest, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(status: int, **body: Any) -> str:
        answer = http.post("/v1/tags", json={"name": "good", **body})
        assert answer.status_code == status, answer.text
        return str(answer.json()["detail"])

    assert "no grasp 32" in refused(404, grasps=named(made.shard_id, 1, 32))
    assert "either names of grasps or a filter" in refused(422)
    assert "no grasp passes" in refused(422, filter={"min_epsilon": 1000})
    for name in ("", " ", "two  spaces", "a\tb", "a\u00a0b", "a/b", "-a", "a" * 65):
        refused(422, name=name, grasps=named(made.shard_id, 1))
    monkeypatch.setattr("graspd.service.pipeline.tagging.MOST_TAGGED", 3)
    assert "at most 3" in refused(413, grasps=named(made.shard_id, 1, 2, 3, 4))
    monkeypatch.setattr("graspd.api.catalog.grasps.MOST_TAGGED", 3)
    assert "narrow it" in refused(413, filter={})
    assert http.get("/v1/tags").json() == [] and MOST_TAGGED > 3
    monkeypatch.setattr("graspd.api.catalog.tags.MOST_TAGS", 1)
    give(http, "first", grasps=named(made.shard_id, 1))
    assert "the maximum" in refused(413, grasps=named(made.shard_id, 1))


def test_a_project_has_tags_of_its_own(services: Services, made: ShardManifest) -> None:
    submits = {name: (Scope.SUBMIT, project) for name, project in (("old", ""), ("new", ""), ("bob", "blue"))}
    people = people_of(services.settings, **submits, eve=(Scope.READ, ""), root=(Scope.ADMIN, ""))
    body = {"name": "good", "grasps": named(made.shard_id, 1)}
    with TestClient(create_app(services.settings, services), base_url="https://graspd.example") as http:

        def does(who: str, method: str, path: str, **content: Any) -> int:
            return http.request(method, path, headers=people[who], **content).status_code

        assert does("old", "POST", "/v1/tags", json=body) == 200
        assert does("eve", "POST", "/v1/tags", json=body) == does("new", "POST", "/v1/tags", json=body) == 403
        assert does("new", "POST", "/v1/tags/good/remove", json={"filter": {}}) == 403
        assert does("new", "DELETE", "/v1/tags/good") == 403
        # Of another project neither the grasp nor the tag is there.
        assert does("bob", "POST", "/v1/tags", json=body) == does("bob", "GET", "/v1/tags/good") == 404
        assert does("bob", "GET", "/v1/grasps?tag=good") == does("bob", "DELETE", "/v1/tags/good") == 404
        assert does("eve", "GET", "/v1/grasps/export?tag=good&format=zip") == 200
        assert does("root", "DELETE", "/v1/tags/good") == 204


def test_a_tag_is_exported_as_rows_and_as_shards(http: TestClient, made: ShardManifest, services: Services) -> None:
    give(http, "good", grasps=named(made.shard_id, 2, 30))
    give(http, "best", grasps=named(made.shard_id, 2))
    address = "/v1/grasps/export?tag=good&format="
    rows = list(csv.DictReader(io.StringIO(http.get(address + "csv").text)))
    assert [(row["row"], row["tags"]) for row in rows] == [("2", "best good"), ("30", "good")]
    assert {row["shard_id"] for row in rows} == {made.shard_id}
    document = http.get(address + "json").json()
    assert [item["tags"] for item in document["items"]] == [["best", "good"], ["good"]]
    assert document["chosen"]["filter"]["tag"] == "good"
    answer = http.get(address + "zip")
    assert answer.headers["content-disposition"] == 'attachment; filename="grasps.zip"'
    with zipfile.ZipFile(io.BytesIO(answer.content)) as packed:
        assert packed.namelist() == ["allegro/mug/base-00000.h5", "subset.json"]
        part = read_shard(packed.read("allegro/mug/base-00000.h5"), kind="base")
        assert json.loads(packed.read("subset.json"))["kept"] == 2
    whole = shard_of(services, made)
    np.testing.assert_array_equal(part["grasp/hand_pose"], whole["grasp/hand_pose"][[2, 30]])
    np.testing.assert_array_equal(part["quality/thresholds_m"], whole["quality/thresholds_m"])
    assert http.get("/v1/grasps/export?tag=good&format=zip").content == answer.content


def test_a_zip_of_nothing_too_much_or_a_damaged_shard_is_refused(
    http: TestClient, made: ShardManifest, services: Services, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = "/v1/grasps/export?format=zip"
    assert http.get(address + "&min_epsilon=1000").status_code == 422
    (services.settings.data_dir / "store" / made.key).write_bytes(b"other bytes")
    answer = http.get(address)
    assert answer.status_code == 500 and made.key in answer.json()["detail"]
    monkeypatch.setattr("graspd.api.catalog.tags.MOST_SHARDS", 0)
    assert http.get(address).status_code == 413


def test_grasps_of_a_dataset_are_those_of_its_cells(http: TestClient, made: ShardManifest, services: Services) -> None:
    http.post("/v1/datasets", json={"name": "d", "hands": ["allegro"], "objects": ["mug"], "grasps": 32})
    plan_all(services)
    finish_all(services, add_job(services, seed=5))
    assert rows_of(http, dataset="d") == list(range(32)) != rows_of(http)
    assert http.get("/v1/grasps?dataset=none").status_code == 404


def test_a_tag_may_be_of_several_words(http: TestClient, made: ShardManifest) -> None:
    assert give(http, " good for training ", grasps=named(made.shard_id, 3))["tag"]["name"] == "good for training"
    assert rows_of(http, tag="good for training") == [3]
    assert http.get("/v1/tags/good%20for%20training").json()["grasps"] == 1
    page = http.get("/grasps?tag=good+for+training").text.partition('id="snippets"')[0]
    assert 'action="/tags/good%20for%20training/delete"' in page and "/grasps?tag=good%20for%20training" in page
    assert unescape(page).count("'good for training'") == 1 and "'good for training.zip'" in unescape(page)
    export = http.get("/v1/grasps/export", params={"tag": "good for training", "format": "csv"})
    assert export.status_code == 200 and " for " not in export.headers["content-disposition"]
    gone = http.post("/tags/good%20for%20training/delete", data={"typed": "good for training"})
    assert "The tag good for training is deleted" in gone.text
