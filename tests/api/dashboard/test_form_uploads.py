"""The form of a job runs the object that it shows: a refused file stays, and no known object takes its place."""

from __future__ import annotations

import json
import re

import pytest
from starlette.testclient import TestClient

from api.dashboard import form_uploads
from service.index.views import AssetView
from service.model import names
from service.model.states import AssetKind
from service.pipeline.backends import Parts
from service.store.library import load_asset, load_asset_files
from tests.api.dashboard.test_pages import FORM

MESH = ("part.stl", b"solid part\nendsolid\n")


@pytest.fixture(autouse=True)
def no_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    # No worker is here: what was not checked before is not checked while the form waits.
    monkeypatch.setattr(form_uploads, "_CHECK_WAIT_S", 0.0)


def check(parts: Parts, asset: AssetView, verdict: str) -> None:
    """What a worker would find."""
    found: dict[str, object] = {"verdict": verdict, "message": "a thing of 60 m", "repairs": [], "facts": {}}
    parts.store.put(names.asset_check(AssetKind.OBJECT, asset.digest), json.dumps(found).encode())
    parts.index.write.add_asset(load_asset(parts.store, AssetKind.OBJECT, asset.digest), found)


def uploaded(http: TestClient, parts: Parts, verdict: str, **options: str) -> AssetView:
    data = {"options": json.dumps(options)} if options else {}
    asset = AssetView.model_validate(http.post("/v1/objects", files={"file": MESH}, data=data).json())
    check(parts, asset, verdict)
    return asset


def jobs(parts: Parts) -> list[str]:
    """Objects of the jobs there are."""
    return [job.request.object for job in parts.index.jobs.page(limit=10).items]


def fields_of(page: str) -> dict[str, str]:
    """What a browser without scripts would send of the form: choices, and what it does not show."""
    picked = {
        name: (re.findall(r'<option value="([^"]*)" selected', body) or re.findall(r'<option value="([^"]*)"', body))[0]
        for name, body in re.findall(r'<select[^>]*name="(\w+)"[^>]*>(.*?)</select>', page, re.DOTALL)
    }
    hidden = dict(re.findall(r'<input type="hidden" name="(\w+)" value="([^"]*)"', page))
    return FORM | picked | hidden


def test_a_refused_file_is_what_the_form_goes_on_to_show(http: TestClient, parts: Parts) -> None:
    uploaded(http, parts, "refuse")
    answer = http.post("/submit", data=FORM, files={"file": MESH})
    assert answer.status_code == 422
    assert "a thing of 60 m" in answer.text
    assert fields_of(answer.text)["object"] == ""
    assert "your file part (refused)" in answer.text
    assert 'data-model="/v1/objects/mug/model"' not in answer.text
    assert jobs(parts) == []


def test_pressing_again_does_not_run_another_object(http: TestClient, parts: Parts) -> None:
    uploaded(http, parts, "refuse")
    page = http.post("/submit", data=FORM, files={"file": MESH}).text
    again = http.post("/submit", data=fields_of(page))
    assert again.status_code == 422 and "a thing of 60 m" in again.text
    assert jobs(parts) == []


def test_a_refused_file_is_checked_again_in_other_units_without_being_sent_again(
    http: TestClient, parts: Parts
) -> None:
    first = uploaded(http, parts, "refuse")
    page = http.post("/submit", data=FORM, files={"file": MESH}).text
    waiting = http.post("/submit", data=fields_of(page) | {"units": "mm"})
    assert waiting.status_code == 409 and "still being checked" in waiting.text
    meant = parts.index.assets.get(AssetKind.OBJECT, "part")
    check(parts, meant, "accept")
    assert http.post("/submit", data=fields_of(waiting.text), follow_redirects=False).status_code == 303
    assert jobs(parts) == ["part"]
    assert meant.digest != first.digest
    assert json.loads(load_asset_files(parts.store, AssetKind.OBJECT, meant.digest)["asset.json"]) == {
        "file": "part.stl", "units": "mm",
    }  # fmt: skip


def test_units_stay_chosen_on_a_page_in_error(http: TestClient, parts: Parts) -> None:
    uploaded(http, parts, "refuse", units="mm")
    page = http.post("/submit", data=FORM | {"units": "mm"}, files={"file": MESH}).text
    assert fields_of(page)["units"] == "mm"


def test_a_known_object_can_be_chosen_instead_of_the_refused_file(http: TestClient, parts: Parts) -> None:
    uploaded(http, parts, "refuse")
    page = http.post("/submit", data=FORM, files={"file": MESH}).text
    answer = http.post("/submit", data=fields_of(page) | {"object": "block"}, follow_redirects=False)
    assert answer.status_code == 303
    assert jobs(parts) == ["block"]


def test_a_file_that_cannot_be_kept_is_asked_for_again(http: TestClient, parts: Parts) -> None:
    page = http.post("/submit", data=FORM, files={"file": ("notes.txt", b"hello")})
    assert "notes.txt holds no object file" in page.text
    again = http.post("/submit", data=fields_of(page.text))
    assert again.status_code == 422 and "choose a known object, or a file" in again.text
    assert jobs(parts) == []


def test_a_mistake_in_another_field_keeps_the_file(http: TestClient, parts: Parts) -> None:
    uploaded(http, parts, "accept")
    page = http.post("/submit", data=FORM | {"grasps": "0"}, files={"file": MESH})
    assert page.status_code == 422
    assert fields_of(page.text)["object"] == "part"


def test_a_form_that_names_no_object_gets_none(http: TestClient, parts: Parts) -> None:
    answer = http.post("/submit", data={key: value for key, value in FORM.items() if key != "object"})
    assert answer.status_code == 422 and "choose a known object, or a file" in answer.text
    assert jobs(parts) == []


def test_an_object_that_is_not_known_is_not_shown_as_the_first_of_those_that_are(http: TestClient) -> None:
    page = http.get("/submit", params={"object": "lost"}).text
    assert fields_of(page)["object"] == "lost"
    assert "lost (not known here)" in page


def test_what_a_form_holds_must_be_there(http: TestClient, parts: Parts) -> None:
    answer = http.post("/submit", data=FORM | {"object": "", "object_held": "0" * 32})
    assert answer.status_code == 422
    assert jobs(parts) == []
