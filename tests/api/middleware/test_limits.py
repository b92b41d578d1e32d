"""Rates, requests at once and quotas, counted in a real Redis that two applications share."""

import asyncio
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.testclient import TestClient

from graspd.api.access.keys import KeyFile, KeyLimits, Scope
from graspd.api.app import create_app
from graspd.api.middleware.limits import Allowance, BodyLimit, Rates
from graspd.service.pipeline.backends import Services
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.settings import Settings
from tests.api.factories import bearer
from tests.fakes import plan_all
from tests.waiting import PATIENCE_S

JOB = {"hand": "allegro", "object": "mug", "grasps": 32}
Twins = Callable[..., list[TestClient]]


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine Redis may be slow to answer, and what is not counted is let in."""
    monkeypatch.setattr("graspd.api.middleware.limits._ANSWER_S", PATIENCE_S)


def test_two_applications_share_one_rate_and_say_when_to_come(make_twins: Twins, keys: KeyFile) -> None:
    headers = bearer(keys.add("me", Scope.READ, limits=KeyLimits(requests_per_minute=2)))
    first, second = make_twins()
    assert first.get("/v1/stats", headers=headers).status_code == 200
    assert second.get("/v1/stats", headers=headers).headers["ratelimit"].startswith('"requests";r=0;t=')
    answer = first.get("/v1/stats", headers=headers)
    assert (answer.status_code, answer.headers["content-type"]) == (429, "application/problem+json")
    assert answer.json()["type"] == "/problems/too-many-requests"
    assert answer.headers["ratelimit-policy"] == '"requests";q=2;w=60'
    # One request of two a minute comes back every 30 s; of these some may be over by now.
    assert 1 <= int(answer.headers["retry-after"]) <= 30


def test_guesses_at_the_login_are_slowed_down_and_health_is_not(make_twins: Twins, keys: KeyFile) -> None:
    headers = bearer(keys.add("me", Scope.READ))
    client, _ = make_twins(address_requests_per_minute=3)
    assert client.get("/v1/stats", headers=bearer("gd_guess")).status_code == 401
    assert [client.post("/login", data={"key": f"gd_{i}"}).status_code for i in range(3)] == [401, 401, 429]
    assert client.get("/v1/stats", headers=headers).status_code == 200, "strangers are counted by address"
    assert {client.get("/healthz").status_code for _ in range(4)} == {200}


def test_limits_of_the_settings_count_for_keys_and_not_while_there_are_none(make_twins: Twins, keys: KeyFile) -> None:
    client, _ = make_twins(requests_per_minute=1, address_requests_per_minute=1)
    assert {client.get("/v1/stats").status_code for _ in range(4)} == {200}
    headers = bearer(keys.add("me", Scope.READ))
    assert [client.get("/v1/stats", headers=headers).status_code for _ in range(2)] == [200, 429]


def test_without_redis_the_limits_let_everybody_in(settings: Settings, services: Services, keys: KeyFile) -> None:
    headers = bearer(keys.add("me", Scope.READ, limits=KeyLimits(requests_per_minute=1)))
    with TestClient(create_app(settings, services), base_url="http://127.0.0.1:8000") as client:
        assert [client.get("/v1/stats", headers=headers).status_code for _ in range(2)] == [200, 200]


def test_only_so_many_requests_are_answered_at_once(redis_server: str, rq_queue: RqQueue) -> None:
    allowance = Allowance(per_minute=0, concurrency=2)

    async def use() -> list[str]:
        rates = Rates(redis_server)
        found = [await rates.enter("key:me", allowance, name) for name in "abc"]
        await rates.leave("key:me", "a")
        found.append(await rates.enter("key:me", allowance, "d"))
        found.append(await rates.enter("key:other", allowance, "e"))
        await rates.close()
        return [admission.refused for admission in found if admission is not None]

    assert asyncio.run(use()) == ["", "", "concurrency", "", ""]


def enter(redis_server: str, allowance: Allowance) -> Any:
    async def ask() -> Any:
        rates = Rates(redis_server)
        admission = await rates.enter("key:me", allowance, "new")
        await rates.close()
        return admission

    return asyncio.run(ask())


def test_a_killed_process_or_a_clock_set_back_shuts_nobody_out_for_long(redis_server: str, rq_queue: RqQueue) -> None:
    rq_queue.connection.zadd("graspd:held:key:me", {"lost": time.time() - 1})
    assert enter(redis_server, Allowance(0, 1)).refused == ""
    assert 0 < rq_queue.connection.pttl("graspd:held:key:me") <= 60_000
    rq_queue.connection.set("graspd:rate:key:me", time.time() + 86400)
    assert enter(redis_server, Allowance(10, 0)).seconds <= 60


def test_jobs_over_the_daily_quota_are_refused_until_midnight(make_twins: Twins, keys: KeyFile) -> None:
    """What is refused, or the same again, costs nothing, and another key has a quota of its own."""
    headers = bearer(keys.add("me", Scope.SUBMIT, limits=KeyLimits(jobs_per_day=2, grasps_in_flight=96)))
    clients = make_twins()
    assert clients[0].post("/v1/jobs", json=JOB | {"hand": "claw"}, headers=headers).status_code == 404
    seeds = (0, 0, 0, 1, 2)
    answers = [clients[i % 2].post("/v1/jobs", json=JOB | {"seed": s}, headers=headers) for i, s in enumerate(seeds)]
    assert [answer.status_code for answer in answers] == [202, 202, 202, 202, 429]
    assert answers[-1].json()["type"] == "/problems/quota-exceeded"
    assert int(answers[-1].headers["retry-after"]) == 12 * 3600 + 1
    other = bearer(keys.add("you", Scope.SUBMIT, limits=KeyLimits(jobs_per_day=1)))
    assert clients[0].post("/v1/jobs", json=JOB | {"seed": 2}, headers=other).status_code == 202


def test_a_dataset_counts_with_all_cells_until_it_ends(make_twins: Twins, keys: KeyFile, services: Services) -> None:
    headers = bearer(keys.add("me", Scope.SUBMIT, limits=KeyLimits(grasps_in_flight=64)))
    client, _ = make_twins()
    matrix = {"name": "d", "hands": ["allegro", "barrett"], "objects": ["mug"], "grasps": 32}
    large = client.post("/v1/datasets", json=matrix | {"grasps": 33}, headers=headers)
    assert large.status_code == 429 and client.get("/v1/datasets", headers=headers).json()["items"] == []
    for _ in range(2):
        assert client.post("/v1/datasets", json=matrix, headers=headers).status_code == 202
    assert client.post("/v1/jobs", json=JOB | {"seed": 1}, headers=headers).status_code == 429
    assert client.post("/v1/datasets/d/cancel", headers=headers).status_code == 202
    plan_all(services)
    assert client.post("/v1/jobs", json=JOB | {"seed": 1}, headers=headers).status_code == 202
    assert client.post("/v1/datasets/d/retry", headers=headers).status_code == 429


async def reads_all(scope: Any, receive: Any, send: Any) -> None:
    while (await receive()).get("more_body"):
        pass


def answer_to(receive: Callable[[], Any], **options: float) -> int:
    """Status that the limit answers while a body comes."""
    sent: list[dict[str, Any]] = []

    async def send(message: Any) -> None:
        sent.append(message)

    limit = BodyLimit(reads_all, upload_paths=frozenset(), upload_bytes=1, **options)
    scope = {"type": "http", "method": "POST", "path": "/v1/jobs", "headers": [], "query_string": b"", "server": None}
    scope["app"] = SimpleNamespace(state=SimpleNamespace(settings=Settings()))
    asyncio.run(limit(scope, receive, send))
    return int(sent[0]["status"])


def test_a_body_that_stops_coming_is_given_up() -> None:
    async def silent() -> dict[str, Any]:
        await asyncio.sleep(60)
        return {}

    assert answer_to(silent, piece_s=0.05) == 408


def test_a_body_that_trickles_in_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, pieces = [0.0], 0

    async def trickling() -> dict[str, Any]:
        nonlocal pieces
        pieces += 1
        clock[0] += 20.0
        return {"type": "http.request", "body": b"x", "more_body": True}

    monkeypatch.setattr("graspd.api.middleware.limits.time.monotonic", lambda: clock[0])
    assert answer_to(trickling) == 408 and pieces == 2
