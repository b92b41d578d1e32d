"""The form of a job runs the object that it shows: a refused file stays, and no known object takes its place."""

import json
import re
from html import unescape
from typing import Any

import pytest
from starlette.testclient import TestClient

from graspd.api.dashboard import form_uploads
from graspd.service.index.views import AssetView
from graspd.service.model import names
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.store.library import load_asset, load_asset_files
from tests.api.dashboard.test_pages import FORM

MESH = ("part.stl", b"solid part\nendsolid\n")
#: What the check of a mesh in millimetres tells beside its message.
TOO_LARGE = {"problem": "the mesh is 60 m long", "options_suggested": [{"scale_to": None}]}
TOO_LARGE |= {"units_suggested": ["mm", "cm"], "lengths_m": {"mm": 0.06, "cm": 0.6}}


@pytest.fixture(autouse=True)
def no_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    # No worker is here: what was not checked before is not checked while the form waits.
    monkeypatch.setattr(form_uploads, "_CHECK_WAIT_S", 0.0)


def check(services: Services, asset: AssetView, verdict: str, facts: Any = None) -> None:
    found = {"verdict": verdict, "message": "a thing of 60 m", "repairs": [], "facts": facts or {}}
    services.store.put(names.asset_key(AssetKind.OBJECT, asset.digest, "check.json"), json.dumps(found).encode())
    services.index.write.add_asset(load_asset(services.store, AssetKind.OBJECT, asset.digest), found)


def uploaded(http: TestClient, services: Services, verdict: str, facts: Any = None, **options: str) -> AssetView:
    data = {"options": json.dumps(options)} if options else {}
    asset = AssetView.model_validate(http.post("/v1/objects", files={"file": MESH}, data=data).json())
    check(services, asset, verdict, facts)
    return asset


def jobs(services: Services) -> list[str]:
    return [job.request.object for job in services.index.jobs.page(limit=10).items]


def fields_of(page: str) -> dict[str, str]:
    picked = {
        name: (re.findall(r'<option value="([^"]*)" selected', body) or re.findall(r'<option value="([^"]*)"', body))[0]
        for name, body in re.findall(r'<select[^>]*name="(\w+)"[^>]*>(.*?)</select>', page, re.DOTALL)
    }
    hidden = dict(re.findall(r'<input type="hidden" name="(\w+)" value="([^"]*)"', page))
    hidden |= dict(re.findall(r'<input type="radio" name="(\w+)" value="([^"]*)" checked', page))
    return FORM | picked | hidden


def sent(http: TestClient, **fields: str) -> str:
    return http.post("/submit", data=FORM | fields, files={"file": MESH}).text


def stored_options(services: Services, asset: AssetView) -> dict[str, Any]:
    return dict(json.loads(load_asset_files(services.store, AssetKind.OBJECT, asset.digest)["asset.json"]))


def test_a_refused_file_stays_on_the_form_and_is_chosen_nowhere_else(http: TestClient, services: Services) -> None:
    uploaded(http, services, "refuse")
    answer = http.post("/submit", data=FORM, files={"file": MESH})
    for page in (answer, http.post("/submit", data=fields_of(answer.text))):  # pressed again, it runs no other object
        assert page.status_code == 422 and "a thing of 60 m" in page.text
        assert jobs(services) == []
    assert fields_of(answer.text)["object"] == ""
    assert "your file part (refused)" in answer.text and 'data-model="/v1/objects/mug/model"' not in answer.text
    known = http.post("/submit", data=fields_of(answer.text) | {"object": "block"}, follow_redirects=False)
    assert known.status_code == 303 and jobs(services) == ["block"]
    for page in ("/submit", "/datasets", "/grasps"):
        assert not re.search(r">\s*part\b", http.get(page).text), page
    assert "part" not in {one["name"] for one in http.get("/v1/objects").json()["items"]}
    everything = http.get("/v1/objects", params={"refused": True}).json()["items"]
    assert ("part", "refuse") in {(one["name"], one["verdict"]) for one in everything}
    assert "part" not in http.get("/v1/objects/nothing").json()["detail"]


def test_a_refused_file_is_checked_in_other_units_unsent(http: TestClient, services: Services) -> None:
    first = uploaded(http, services, "refuse")
    waiting = http.post("/submit", data=fields_of(sent(http)) | {"units": "mm"})
    assert waiting.status_code == 409 and "still being checked" in waiting.text
    meant = services.index.assets.get(AssetKind.OBJECT, "part")
    check(services, meant, "accept")
    assert http.post("/submit", data=fields_of(waiting.text), follow_redirects=False).status_code == 303
    assert jobs(services) == ["part"]
    assert meant.digest != first.digest
    assert stored_options(services, meant) == {"file": "part.stl", "units": "mm"}


def test_a_file_that_cannot_be_kept_is_asked_for_again(http: TestClient, services: Services) -> None:
    page = http.post("/submit", data=FORM, files={"file": ("notes.txt", b"hello")})
    assert "notes.txt holds no object file" in page.text
    again = http.post("/submit", data=fields_of(page.text))
    assert again.status_code == 422 and "select a known object, or a file" in again.text
    assert jobs(services) == []


def test_a_mistake_in_another_field_keeps_the_file(http: TestClient, services: Services) -> None:
    uploaded(http, services, "accept", units="mm")
    page = http.post("/submit", data=FORM | {"grasps": "0", "units": "mm"}, files={"file": MESH})
    assert page.status_code == 422
    assert (fields_of(page.text)["object"], fields_of(page.text)["units"]) == ("part", "mm")


def test_a_form_that_names_no_known_object_gets_none(http: TestClient, services: Services) -> None:
    answer = http.post("/submit", data={key: value for key, value in FORM.items() if key != "object"})
    assert answer.status_code == 422 and "select a known object, or a file" in answer.text
    assert http.post("/submit", data=FORM | {"object": "", "object_held": "0" * 32}).status_code == 422
    assert jobs(services) == []
    page = http.get("/submit", params={"object": "lost"}).text
    assert fields_of(page)["object"] == "lost"
    assert "lost (unknown)" in page


def fixes_of(page: str) -> dict[str, str]:
    found = re.findall(r'<button class="button small" name="object_fix" value="([^"]*)"[^>]*>([^<]*)<', page)
    return {words: unescape(value) for value, words in found}


def test_a_refusal_is_told_in_words_with_buttons(http: TestClient, services: Services) -> None:
    asset = uploaded(http, services, "refuse", TOO_LARGE)
    page = sent(http, object_fix="{}")  # as htmx sends a file at once: the whole form, which is not submitted
    assert "the mesh is 60 m long" in page and "a thing of 60 m" not in page
    units = ["Read in millimetres: 60 mm long", "Read in centimetres: 600 mm long"]
    assert list(fixes_of(page)) == [*units, "Scale to this size"]
    assert f'data-model="/v1/objects/{asset.digest}/model"' in page and "shows it in millimetres" in page
    assert 'data-blocks="part was refused' in page


@pytest.mark.parametrize(
    ("words", "field", "said"),
    [
        ("Read in millimetres: 60 mm long", {}, {"units": "mm"}),
        ("Scale to this size", {"object_scale_to": "120"}, {"scale_to": 0.12}),
    ],
)
def test_a_fix_checks_again_and_submits_nothing(
    http: TestClient, services: Services, words: str, field: dict[str, str], said: dict[str, Any]
) -> None:
    uploaded(http, services, "refuse", TOO_LARGE)
    page = sent(http)
    again = http.post("/submit", data=fields_of(page) | field | {"object_fix": fixes_of(page)[words]})
    assert again.status_code == 200 and jobs(services) == []
    assert fields_of(again.text)["object"] == "part"
    assert fields_of(again.text)["units"] == said.get("units", "m")
    assert stored_options(services, services.index.assets.get(AssetKind.OBJECT, "part")) == {"file": "part.stl", **said}


def test_a_fix_without_its_number_asks_for_it(http: TestClient, services: Services) -> None:
    uploaded(http, services, "refuse", TOO_LARGE)
    page = http.post("/submit", data=FORM, files={"file": MESH}).text
    fix = fixes_of(page)["Scale to this size"]
    for typed, says in (("", "a value is missing"), ("wide", "&#39;wide&#39; is no number")):
        again = http.post("/submit", data=fields_of(page) | {"object_scale_to": typed, "object_fix": fix})
        assert again.status_code == 200 and f"Longest side [mm]: {says}" in again.text
        assert fields_of(again.text)["object_held"] == fields_of(page)["object_held"]


def test_each_suggested_option_is_a_button(http: TestClient, services: Services) -> None:
    told = {
        "Keep only the largest part": {"keep_largest": True},
        "Take the parts as one rigid body": {"rigid": True},
        "Accept the open mesh": {"allow_open": True},
        "Use palm as root link": {"root": "palm"},
        "Fix wrist at 0": {"fix": {"wrist": 0}},
    }
    uploaded(http, services, "refuse", {"problem": "it is none", "options_suggested": [*told.values()]})
    page = sent(http)
    assert 'id="object-fields" data-model=""' in page, "without suggested units there is no picture"
    assert {said: json.loads(value) for said, value in fixes_of(page).items()} == told


def test_facts_that_an_upload_says_of_itself_break_no_page(http: TestClient, services: Services) -> None:
    odd = {"units_suggested": "mm", "options_suggested": [3, {}, {"a": 1}, {"root": "<b>"}], "lengths_m": [1]}
    uploaded(http, services, "refuse", odd)
    assert list(fixes_of(sent(http))) == ["Use &lt;b&gt; as root link"]


def test_a_file_of_other_content_is_another_object(http: TestClient, services: Services) -> None:
    first = uploaded(http, services, "accept")
    other = {"file": ("part.stl", b"solid another\nendsolid\n")}
    assert http.post("/v1/objects", files=other, data={"rename": "true"}).json()["name"] == "part-2"
    again = http.post("/v1/objects", files={"file": MESH}, data={"rename": "true"}).json()
    assert (again["name"], again["digest"]) == ("part", first.digest)


def test_a_refused_file_is_found_again_though_its_name_is_taken(http: TestClient, services: Services) -> None:
    refused = uploaded(http, services, "refuse")
    good = http.post("/v1/objects", files={"file": ("part.stl", b"solid another\nendsolid\n")}).json()
    for sent in ({}, {"name": "other"}):
        again = http.post("/v1/objects", files={"file": MESH}, data=sent)
        assert (again.status_code, again.json()["digest"], again.json()["verdict"]) == (202, refused.digest, "refuse")
    assert http.get("/v1/objects/part").json()["digest"] == good["digest"]
