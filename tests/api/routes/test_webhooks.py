"""The feed of ends, and webhooks: who is told what, signed how, and tried how often."""

import hashlib
import hmac
import json
import threading
import time
from concurrent.futures import wait
from contextlib import closing
from typing import Any

import pytest
from pydantic import SecretStr
from starlette.testclient import TestClient

from graspd.api.access.keys import Scope
from graspd.api.app import create_app
from graspd.service.index.index import Index
from graspd.service.index.outbox import append_end_events
from graspd.service.index.rebuild import rebuild
from graspd.service.model.webhooks import WAITS_S, Webhook
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.webhook_dispatcher import AT_ONCE, SLOW_AT_ONCE, Response, WebhookDispatcher
from graspd.service.settings import Settings
from tests.api.conftest import BASE_URL
from tests.api.factories import add_job, finish_all, people_of
from tests.fakes import plan_all
from tests.waiting import PATIENCE_S, until

ADDRESS = "https://ci.example.org/graspd"
MASTER = "a secret of the operator's"
JOB = {"hand": "allegro", "object": "mug", "grasps": 32}


@pytest.fixture
def settings(settings: Settings) -> Settings:
    return settings.model_copy(update={"webhook_secret": SecretStr(MASTER)})


class Ear:
    def __init__(self, services: Services) -> None:
        self.services = services
        self.heard: list[tuple[str, bytes, dict[str, str]]] = []
        self.answer = Response(200)
        self.dispatcher = WebhookDispatcher(services, threading.Event(), send=self.send)

    def send(self, url: str, body: bytes, headers: dict[str, str], **_: Any) -> Response:
        self.heard.append((url, body, headers))
        return self.answer

    def round(self, later_s: float = 0.0) -> int:
        self.dispatcher.report_dataset_ends()
        return self.deliver(now=time.time() + later_s)

    def deliver(self, *, now: float | None = None) -> int:
        """Starts deliveries and waits for their ends; how many were tried."""
        started = self.dispatcher.start_deliveries(now=now)
        wait(started)
        return len(started)


@pytest.fixture
def ear(services: Services) -> Ear:
    return Ear(services)


def add(http: TestClient, **said: Any) -> dict[str, Any]:
    answer = http.post("/v1/webhooks", json={"url": ADDRESS, **said})
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def end_a_job(services: Services, **fields: Any) -> str:
    record = add_job(services, **fields)
    finish_all(services, record)
    return record.id


def test_the_feed_tells_of_each_end_once_and_in_order(http: TestClient, services: Services) -> None:
    jobs = [end_a_job(services, seed=seed) for seed in (1, 2)]
    page = http.get("/v1/events").json()
    assert [(one["subject"], one["state"]) for one in page["items"]] == [(job, "succeeded") for job in jobs]
    assert http.get(f"/v1/events?since={page['next']}").json() == {"items": [], "next": page["next"]}
    later = http.get(f"/v1/events?since={page['items'][0]['seq']}").json()["items"]
    assert [one["subject"] for one in later] == jobs[1:]


def test_a_job_that_is_retried_and_cancelled_again_ends_twice(http: TestClient) -> None:
    job = http.post("/v1/jobs", json=JOB).json()["id"]
    for action in ("cancel", "retry", "cancel"):
        assert http.post(f"/v1/jobs/{job}/{action}").status_code == 202
    assert [one["state"] for one in http.get("/v1/events").json()["items"]] == ["cancelled", "cancelled"]


def test_a_dataset_that_ended_is_told_once(http: TestClient, services: Services, ear: Ear) -> None:
    http.post("/v1/datasets", json={"name": "d", "hands": ["allegro"], "objects": ["mug"], "grasps": 32})
    ear.round()
    http.post("/v1/datasets/d/cancel")
    plan_all(services)
    ear.round()
    ear.round()
    http.delete("/v1/datasets/d")
    assert http.post("/v1/datasets/d/restore").status_code == 200
    plan_all(services)
    ear.round()
    told = [one for one in http.get("/v1/events").json()["items"] if one["kind"] == "dataset"]
    assert [(one["subject"], one["state"]) for one in told] == [("d", "cancelled")]


def test_what_is_sent_is_signed_with_the_time(http: TestClient, services: Services, ear: Ear) -> None:
    hook = add(http)
    job = end_a_job(services)
    assert ear.round() == 1
    url, body, headers = ear.heard[0]
    said = dict(part.split("=") for part in headers["X-Graspd-Signature"].split(","))
    expected = hmac.new(hook["secret"].encode(), said["t"].encode() + b"." + body, hashlib.sha256).hexdigest()
    assert hmac.compare_digest(said["v1"], expected) and abs(int(said["t"]) - time.time()) < 120
    assert url == ADDRESS and json.loads(body)["subject"] == job
    assert MASTER not in str(headers) + hook["secret"] + str(body)


def test_what_is_not_taken_is_retried_with_longer_waits(http: TestClient, services: Services, ear: Ear) -> None:
    hook = add(http)
    end_a_job(services)
    ear.answer = Response(500, "answered 500")
    assert ear.round() == 1 and ear.round() == 0
    for pause in WAITS_S:
        assert ear.round(pause + 1) == 1
    assert ear.round(10 * WAITS_S[-1]) == 0
    (log,) = http.get(f"/v1/webhooks/{hook['id']}/deliveries").json()
    assert (log["state"], log["attempts"], log["status"]) == ("failed", len(WAITS_S) + 1, 500)
    # Each attempt has the same number, so who has taken it may know it again.
    assert len({headers["X-Graspd-Delivery"] for _, _, headers in ear.heard}) == 1


def test_a_webhook_is_told_of_later_ends_it_asked_for(http: TestClient, services: Services, ear: Ear) -> None:
    end_a_job(services, seed=1)
    add(http, states=["failed"])
    hook = add(http)
    assert ear.round() == 0, "what ended before"
    end_a_job(services, seed=2)
    assert http.delete(f"/v1/webhooks/{hook['id']}").status_code == 204
    assert ear.round() == 0 and len(http.get("/v1/webhooks").json()) == 1


def test_webhooks_survive_a_rebuild_and_tell_nothing_old(http: TestClient, services: Services, ear: Ear) -> None:
    hook = add(http)
    end_a_job(services)
    ear.round()
    with closing(Index("sqlite://")) as fresh:
        rebuild(fresh, services.store)
        assert [one.id for one in fresh.outbox.webhooks()] == [hook["id"]]
        fresh.outbox.create_deliveries()
        assert fresh.outbox.due_deliveries(time.time()) == []
    rebuild(services.index, services.store)
    ear.round()
    assert len(ear.heard) == 1


def test_no_address_or_no_secret_of_the_operators_is_refused(http: TestClient, services: Services) -> None:
    for url in ("ftp://a.example", "https://me:pw@a.example/", "nonsense"):
        assert http.post("/v1/webhooks", json={"url": url}).status_code in (400, 422)
    bare = services.settings.model_copy(update={"webhook_secret": None})
    app = create_app(bare, Services(bare, services.store, services.index, services.queue))
    assert TestClient(app, base_url=BASE_URL).post("/v1/webhooks", json={"url": ADDRESS}).status_code == 409


def test_a_project_is_told_of_its_own_ends_alone(settings: Settings, services: Services, ear: Ear) -> None:
    people = people_of(settings, ann=(Scope.SUBMIT, "red"), bob=(Scope.SUBMIT, "blue"))
    client = TestClient(create_app(settings, services), base_url="https://graspd.example")
    hook = client.post("/v1/webhooks", json={"url": ADDRESS}, headers=people["bob"]).json()
    for who in people:
        job = client.post("/v1/jobs", json=JOB, headers=people[who]).json()["id"]
        client.post(f"/v1/jobs/{job}/cancel", headers=people[who])
    assert ear.round() == 1 and json.loads(ear.heard[0][1])["subject"] == job
    assert [one["subject"] for one in client.get("/v1/events", headers=people["bob"]).json()["items"]] == [job]
    address = f"/v1/webhooks/{hook['id']}"
    assert client.get("/v1/webhooks", headers=people["ann"]).json() == []
    assert client.get(f"{address}/deliveries", headers=people["ann"]).status_code == 404
    assert client.delete(address, headers=people["ann"]).status_code == 404


def hooks(services: Services, count: int, project: str, host: str, created: str = "2026-01-01T00:00:00Z") -> None:
    for number in range(count):
        what = {"id": f"{project}{number:031}", "url": f"https://{host}/{number}", "states": ("succeeded",)}
        services.index.outbox.add(Webhook(**what, created=created, project=project))


def end_jobs_of(services: Services, projects: str, seq: str = "") -> None:
    ended = {"kind": "job", "state": "succeeded", "owner": ""}
    with services.index.database.write_transaction() as connection:
        append_end_events(
            connection, [ended | {"subject": f"{project}{seq}", "project": project} for project in projects]
        )


class Silent(Ear):
    """Addresses of `dead` do not answer until they are let go."""

    def __init__(self, services: Services) -> None:
        super().__init__(services)
        self.asked: list[str] = []
        self.let_go = threading.Event()
        self.good = threading.Event()

    def send(self, url: str, body: bytes, headers: dict[str, str], **_: Any) -> Response:
        if "//dead" in url:
            self.asked.append(url)
            self.let_go.wait(60)
            return Response(None, "no answer in time")
        self.heard.append((url, body, headers))
        self.good.set()
        return Response(200)


@pytest.mark.parametrize(("dead", "theirs"), [(20, "a"), (20, "b"), (3 * AT_ONCE, "a")])
def test_silent_addresses_keep_no_other_waiting(services: Services, dead: int, theirs: str) -> None:
    ear = Silent(services)
    hooks(services, dead, theirs, "dead")
    good = Webhook(id="c" * 32, url="https://good/", states=("succeeded",), created="2026-02-01T00:00:00Z", project="b")
    services.index.outbox.add(good)
    end_jobs_of(services, "ab")
    try:
        ear.dispatcher.start_deliveries()
        assert ear.good.wait(30)
        # What is silent is not asked again while it is asked.
        end_jobs_of(services, "ab", "again")
        ear.dispatcher.start_deliveries()
        assert len(set(ear.asked)) == len(ear.asked)
    finally:
        ear.let_go.set()


def test_a_burst_of_ends_is_told_without_a_pause(services: Services, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.service.pipeline.webhook_dispatcher._PAUSE_S", PATIENCE_S)
    ear, stop = Ear(services), threading.Event()
    ear.dispatcher = WebhookDispatcher(services, stop, send=ear.send)
    hooks(services, 1, "a", "good")
    for number in range(20):
        end_jobs_of(services, "a", str(number))
    ear.deliver()
    thread = threading.Thread(target=ear.dispatcher.run)
    thread.start()
    try:
        until(lambda: len(ear.heard) == 20, "all are told")
    finally:
        stop.set()
        ear.dispatcher._ended.set()
        thread.join()


def test_an_address_that_failed_rests_with_all_that_waits_for_it(services: Services, ear: Ear) -> None:
    hooks(services, 1, "a", "busy")
    ear.answer = Response(503, "answered 503")
    for number in range(3):
        end_jobs_of(services, "a", str(number))
    assert ear.round() == 1 and ear.round() == 0
    end_jobs_of(services, "a", "new")
    assert ear.round() == 0
    ear.answer = Response(200)
    assert [ear.round(WAITS_S[0] + 1), ear.round(), ear.round(), ear.round(), ear.round()] == [1, 1, 1, 1, 0]
    assert [json.loads(body)["subject"] for _, body, _ in ear.heard] == ["a0", "a0", "a1", "a2", "anew"]


def test_addresses_that_failed_leave_half_of_the_room(services: Services) -> None:
    ear = Silent(services)
    hooks(services, AT_ONCE, "a", "dead")
    end_jobs_of(services, "a")
    ear.let_go.set()
    assert ear.deliver() == AT_ONCE
    ear.let_go.clear()
    try:
        assert len(ear.dispatcher.start_deliveries(now=time.time() + WAITS_S[0] + 1)) == SLOW_AT_ONCE
    finally:
        ear.let_go.set()


def test_an_address_that_may_not_be_reached_is_given_up_at_once(services: Services, ear: Ear) -> None:
    hooks(services, 1, "a", "inside")
    end_jobs_of(services, "a", "1")
    end_jobs_of(services, "a", "2")
    ear.answer = Response(None, "the address is not public", is_final=True)
    assert ear.round() == 1 and ear.round(10 * WAITS_S[-1]) == 0
    assert {one.state for one in services.index.outbox.delivery_log(f"a{0:031}")} == {"failed"}
