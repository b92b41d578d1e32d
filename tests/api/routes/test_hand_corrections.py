"""Corrections of a hand: what was guessed is said instead, and is a hand of its own."""

import json
from typing import Any

import pytest
from starlette.testclient import TestClient

from graspd.api.access.keys import Scope
from graspd.api.app import create_app
from graspd.service.model import names
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from graspd.service.store.assets import builtin_files
from graspd.service.store.descriptions import MAX_ENTRIES
from graspd.service.store.library import load_asset, load_asset_files
from tests.api.conftest import BASE_URL
from tests.api.factories import people_of, zipped
from tests.damage import overwrite

FILES = builtin_files(AssetKind.HAND, "barrett")
SAID = {"closing": {"finger_1_spread": 1}, "preshape": {"finger_2_medial": -0.3}}
WRONG = {"approach_x=far": "no number", "closing.0=7": "-1, 0 or 1", "palm_link=<b>": "&lt;b&gt;", "name=a b": "name"}


def corrected(http: TestClient, body: dict[str, Any], hand: str = "barrett") -> Any:
    return http.post(f"/v1/hands/{hand}/corrections", json=body)


def test_a_corrected_hand_is_another_one_of_the_same_files(http: TestClient, services: Services) -> None:
    answer = corrected(http, {"closing": {"finger_1_spread": 1}, "preshape": {"finger_2_medial": -0.3}})
    assert answer.status_code == 202, answer.text
    made = http.get(answer.headers["location"]).json()
    assert (made["name"], made["verdict"]) == ("barrett-2", None)
    kept = load_asset_files(services.store, AssetKind.HAND, made["digest"])
    said = json.loads(kept.pop("asset.json"))
    assert kept == {name: data for name, data in FILES.items() if name != "asset.json"}
    assert said["closing"]["finger_1_spread"] == 1 and said["closing"]["finger_2_medial"] == -1
    # The joint that closes another way has its pre-shape guessed anew.
    assert "finger_1_spread" not in said["preshape"] and said["preshape"]["finger_2_medial"] == -0.3
    assert said["root"] == said["palm"]["link"] == "palm" and len(said["fingertips"]) == 3
    assert [check.name for check in services.index.feed.ready_checks(now=1e12, limit=9)] == ["barrett-2"]


def test_the_same_corrections_are_the_same_hand(http: TestClient) -> None:
    first = corrected(http, {"closing": {"finger_1_spread": 1}}).json()
    assert corrected(http, {"closing": {"finger_1_spread": 1}}).json()["digest"] == first["digest"]
    assert corrected(http, {"closing": {"finger_1_spread": -1}}).json()["name"] == "barrett-3"
    assert corrected(http, {"name": "mine", "closing": {"finger_2_medial": 1}}).json()["name"] == "mine"
    answer = corrected(http, {"name": "mine", "closing": {"finger_1_medial": -1}})
    assert answer.status_code == 409 and "'mine'" in answer.json()["detail"]


def test_what_a_hand_does_not_have_is_refused_and_leaves_nothing(http: TestClient) -> None:
    before = http.get("/v1/hands").json()
    refused: tuple[tuple[dict[str, Any], str], ...] = (
        ({"closing": {"elbow": 1}}, "no joint 'elbow'"),
        ({"preshape": {"finger_1_medial": 3}}, "outside its limits"),
        ({"fingertips": ["elbow"]}, "'elbow' is no link that a joint moves"),
        ({"fingertips": []}, "fingertips"),
        ({"palm": {"link": "elbow"}}, "no link 'elbow'"),
        ({"palm": {"link": "palm", "approach": [0, 0, 0]}}, "no direction"),
        ({"closing": {"finger_1_medial": 2}}, "closing"),
        ({"closing": {str(n): 1 for n in range(MAX_ENTRIES + 1)}}, "closing"),
        ({"closing": {"x" * 300: 1}}, "closing"),
        ({"name": "../up", "closing": {}}, "name"),
        ({"root": "palm"}, "root"),
    )
    for body, says in refused:
        answer = corrected(http, body)
        assert answer.status_code == 422 and says in answer.text, answer.text
    assert http.get("/v1/hands").json() == before


def test_a_number_that_is_none_is_refused(http: TestClient) -> None:
    for number in ("NaN", "Infinity", "1e999"):
        text = f'{{"preshape": {{"finger_1_medial": {number}}}}}'
        answer = http.post("/v1/hands/barrett/corrections", content=text, headers={"content-type": "application/json"})
        assert answer.status_code == 422


def test_an_unknown_hand_or_one_without_a_model_is_not_found(http: TestClient) -> None:
    assert corrected(http, SAID, hand="nobody").status_code == 404
    http.post("/v1/hands", files={"file": ("new.urdf", b"<robot/>")})
    assert corrected(http, SAID, hand="new").status_code == 404


def test_a_model_of_an_older_version_says_the_mend(http: TestClient, services: Services) -> None:
    made = http.post("/v1/hands", files={"file": ("old.urdf", b"<robot/>")}).json()
    mug = http.get("/v1/objects/mug").json()["digest"]
    for model in (b"glTF", b"glTF" + bytes(40), services.store.get(names.asset_model_key(AssetKind.OBJECT, mug))):
        key = names.asset_model_key(AssetKind.HAND, made["digest"])
        services.store.delete(key)
        services.store.put(key, model)
        answer = corrected(http, SAID, hand="old")
        assert answer.status_code == 409 and "graspd hands check --write" in answer.json()["detail"]
        assert "older version" in http.get("/hands/old").text


def test_damaged_files_or_a_long_description_are_refused(http: TestClient, services: Services, monkeypatch) -> None:
    monkeypatch.setattr("graspd.api.catalog.assets.MAX_BYTES", 100)
    answer = corrected(http, SAID)
    assert answer.status_code == 413 and "give fewer corrections" in answer.json()["detail"]
    key = names.asset_files_key(AssetKind.HAND, http.get("/v1/hands/barrett").json()["digest"])
    overwrite(services.store, key, zipped({"other.urdf": b"<robot/>"}))
    answer = corrected(http, SAID)
    assert answer.status_code == 500 and "upload it again" in answer.json()["detail"]


def test_a_reader_corrects_nothing_and_a_writer_owns_the_hand(settings: Settings, services: Services) -> None:
    people = people_of(settings, reader=(Scope.READ, ""), writer=(Scope.SUBMIT, ""))
    with TestClient(create_app(settings, services), base_url=BASE_URL) as http:
        body, path = {"closing": {"finger_1_spread": 1}}, "/v1/hands/barrett/corrections"
        assert http.post(path, json=body).status_code == 401
        assert http.post(path, json=body, headers=people["reader"]).status_code == 403
        assert http.post("/hands/barrett", data={"closing.0": "1"}, headers=people["reader"]).status_code == 403
        assert "Save as a new hand" not in http.get("/hands/barrett", headers=people["reader"]).text
        made = http.post(path, json=body, headers=people["writer"]).json()
        assert load_asset(services.store, AssetKind.HAND, made["digest"]).owner == made["owner"] != ""


def test_the_page_has_a_field_for_each_guess_without_scripts(http: TestClient) -> None:
    page = http.get("/hands/barrett").text
    assert page.count('type="radio" name="closing.') == 3 * page.count('name="preshape.')
    assert 'name="palm_link"' in page and 'name="fingertip"' in page and "asset.json" in page
    form = {"palm_link": "palm", "approach_x": "1", "closing.0": "1", "fingertip": "finger_1_distal_link"}
    answer = http.post("/hands/barrett", data=form, follow_redirects=False)
    assert answer.status_code == 303
    made = http.get("/v1/hands/barrett-2").json()
    assert answer.headers["location"] == f"/hands/{made['digest']}"
    shown = http.get(answer.headers["location"]).text
    assert "A worker checks the hand" in shown and 'data-poll="2"' in shown


@pytest.mark.parametrize(("typed", "says"), WRONG.items())
def test_a_wrong_form_is_shown_again_with_what_is_wrong(http: TestClient, typed: str, says: str) -> None:
    form = {"palm_link": "palm", "fingertip": "finger_1_distal_link"} | dict([typed.split("=")])
    answer = http.post("/hands/barrett", data=form)
    assert answer.status_code == 422 and says in answer.text and "cannot be saved" in answer.text


def test_hands_are_listed_with_their_own_words_as_text(http: TestClient) -> None:
    options = {"facts": {"dofs": 7, "fingertips": "<b>", "guessed": 3}}
    http.post("/v1/hands", files={"file": ("odd.urdf", b"<robot/>")}, data={"options": json.dumps(options)})
    page = http.get("/hands")
    assert page.status_code == 200
    assert "odd" in page.text and "being checked" in page.text and "<b>" not in page.text
    assert http.get("/hands/odd").status_code == 200
