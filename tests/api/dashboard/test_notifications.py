"""The bell and webhooks in the browser; what a visitor without rights is not offered."""

import re

import pytest
from pydantic import SecretStr
from starlette.testclient import TestClient

from graspd.api.access.keys import KeyFile, Scope
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from tests.api.factories import add_job, bearer, fail, finish_all

URL = "https://ci.example.org/graspd"


@pytest.fixture
def settings(settings: Settings) -> Settings:
    return settings.model_copy(update={"webhook_secret": SecretStr("s" * 16), "docs_url": "https://docs.example.org"})


def unread(page: str) -> str:
    return re.findall(r'id="bell".*?aria-label="([^"]*)"', page)[0]


def test_the_bell_counts_ends_since_the_last_visit(http: TestClient, services: Services) -> None:
    assert unread(http.get("/").text) == "Notifications"
    finish_all(services, add_job(services))
    fail(services, add_job(services, seed=1), "a reason")
    assert unread(http.get("/workers").text) == "Notifications: 2 new"
    page = http.get("/notifications").text
    assert page.count("allegro on mug") == page.count(", new") == 2 and unread(page) == "Notifications"
    assert unread(http.get("/").text) == "Notifications"
    fail(services, add_job(services, seed=2), "a reason")
    assert unread(http.get("/").text) == "Notifications: 1 new"


def test_the_bell_counts_only_what_the_visitor_submitted(http: TestClient, services: Services, keys: KeyFile) -> None:
    mine, other = (keys.add(name, Scope.SUBMIT) for name in ("ann", "bob"))
    job = http.post("/v1/jobs", json={"hand": "allegro", "object": "mug"}, headers=bearer(mine)).json()["id"]
    http.post(f"/v1/jobs/{job}/cancel", headers=bearer(mine)).raise_for_status()
    told = [unread(http.get("/", headers=bearer(key)).text) for key in (mine, other)]
    assert told == ["Notifications: 1 new", "Notifications"]


def test_a_webhook_is_set_in_the_browser(http: TestClient) -> None:
    made = http.post("/notifications", data={"url": URL, "states": ["failed"]}).text
    assert "whsec_" in made
    page = http.get("/notifications").text
    assert "whsec_" not in page and URL in page and "no delivery yet" in page
    (hook,) = http.get("/v1/webhooks").json()
    assert (hook["url"], hook["states"]) == (URL, ["failed"])
    assert "The webhook is deleted." in http.post(f"/notifications/{hook['id']}/delete").text
    assert http.get("/v1/webhooks").json() == []


@pytest.mark.parametrize(
    ("sent", "words"),
    [({"url": URL}, "choose at least one state"), ({"url": "ftp://h/", "states": ["failed"]}, "https://host/path")],
)
def test_a_wrong_webhook_is_explained(http: TestClient, sent: dict[str, str], words: str) -> None:
    answer = http.post("/notifications", data=sent)
    assert answer.status_code == 422 and words in answer.text and f'value="{sent["url"]}"' in answer.text
    assert http.get("/v1/webhooks").json() == []


def test_pages_offer_what_the_visitor_may_do(http: TestClient, keys: KeyFile) -> None:
    def offered(path: str, *key: str) -> set[str]:
        page = http.get(path, headers=bearer(key[0]) if key else {}).text
        found = {"Usage": ">Usage</a>", "bell": 'id="bell"', "webhooks": "Add the webhook"}
        assert ('href="https://docs.example.org"' in page) and ('href="/docs"' in page)
        return {name for name, words in found.items() if words in page}

    assert offered("/notifications") == {"Usage", "bell", "webhooks"}
    reader, writer = (keys.add(name, scope) for name, scope in (("eve", Scope.READ), ("ann", Scope.SUBMIT)))
    assert offered("/notifications", reader) == {"Usage", "bell"}
    assert offered("/notifications", writer) == {"Usage", "bell", "webhooks"}
    assert offered("/login") == set()
