"""Conditional requests and HEAD on downloads (RFC 9110), methods of an address, framing of bodies."""

from __future__ import annotations

from itertools import product

import pytest
from fastapi import FastAPI
from httpx import Response
from starlette.testclient import TestClient

from graspd.service.pipeline.backends import Services
from tests.api.factories import add_job, finish_all


@pytest.fixture
def file(http: TestClient, services: Services) -> str:
    return f"/v1/shards/{finish_all(services, add_job(services))[0].shard_id}/file"


MODEL = "/v1/hands/allegro/model"


def test_what_a_client_has_is_not_sent_again(http: TestClient, file: str) -> None:
    for address in (file, MODEL):
        etag = http.get(address).headers["etag"]
        for form, method in product(("{}", "W/{}", '"other", {}', "*", '"other"'), ("GET", "HEAD")):
            answer = http.request(method, address, headers={"If-None-Match": form.format(etag), "Range": "bytes=0-9"})
            if form == '"other"':
                assert answer.is_success
                continue
            assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", etag)
            assert "cache-control" in answer.headers


def test_half_a_file_is_completed_only_where_it_is_the_same(http: TestClient, file: str) -> None:
    whole = http.get(file)
    for validator in ("{}", '"other"', "W/{}", "Sat, 21 Nov 2026 00:00:00 GMT"):
        answer = http.get(file, headers={"Range": "bytes=100-", "If-Range": validator.format(whole.headers["etag"])})
        wanted = (206, whole.content[100:]) if validator == "{}" else (200, whole.content)
        assert (answer.status_code, answer.content) == wanted


def test_head_says_what_get_would_and_sends_nothing(http: TestClient, file: str) -> None:
    same = ("content-length", "content-type", "etag", "cache-control", "accept-ranges")
    for address in (file, MODEL):
        whole, head = http.get(address), http.head(address, headers={"Range": "bytes=0-9"})
        assert (head.status_code, head.content) == (200, b"")
        assert {name: head.headers.get(name) for name in same} == {name: whole.headers.get(name) for name in same}


def _kind(answer: Response) -> tuple[int, str | None]:
    return answer.status_code, answer.headers.get("content-type")


def test_head_is_answered_wherever_get_is(app: FastAPI, http: TestClient) -> None:
    paths = {getattr(route, "path", "{") for route in app.routes if "GET" in (getattr(route, "methods", None) or ())}
    endless = {path for path in paths if path.endswith(("/events", "/stream"))} - {"/v1/events"}
    asked = sorted(path for path in paths - endless if "{" not in path)
    assert {"/", "/healthz", "/readyz", "/metrics", "/v1/jobs", "/openapi.json"} <= set(asked)
    answers = {path: (http.get(path), http.head(path)) for path in asked}
    differing = [path for path, (get, head) in answers.items() if head.content or _kind(head) != _kind(get)]
    assert not differing


def test_head_is_logged_and_counted_as_head(app: FastAPI, http: TestClient) -> None:
    http.head("/healthz")
    assert 'method="HEAD",route="/healthz"' in app.state.metrics.render(app.state.overview.snapshot()).decode()


def test_allow_names_head_beside_get(http: TestClient) -> None:
    answer = http.put("/v1/jobs")
    assert (answer.status_code, answer.headers["allow"]) == (405, "GET, HEAD, POST")
    assert answer.json()["type"] == "/problems/method-not-allowed"


def test_an_encoded_body_is_refused_by_its_encoding(http: TestClient) -> None:
    places = (("POST", "/v1/jobs"), ("POST", "/submit"), ("DELETE", "/v1/jobs/x"))
    for encoding, (method, path) in product(("gzip", "zstd", "gzip, br"), places):
        answer = http.request(method, path, content=b"x", headers={"Content-Encoding": encoding})
        assert (answer.status_code, answer.headers["accept-encoding"]) == (415, "identity")
        assert encoding in answer.text
    assert http.post("/v1/jobs", json={}, headers={"Content-Encoding": "identity"}).status_code == 422


def test_a_day_is_a_full_date_and_nothing_else(http: TestClient) -> None:
    odd = ("0", "86400", "2026-01-31T00:00:00", "20260131", "2026-1-31", "2026-02-30")
    for path in ("/v1/usage", "/v1/usage.csv", "/usage"):
        assert http.get(path, params={"since": "2026-01-30", "until": "2026-01-31"}).status_code == 200
        for day, name in product(odd, ("since", "until")):
            assert http.get(path, params={name: day}).status_code == 422, (name, day)


def test_an_estimate_names_the_one_method_that_works(http: TestClient) -> None:
    for method in ("GET", "HEAD", "PUT", "OPTIONS", "PROPFIND"):
        answer = http.request(method, "/v1/datasets/estimate")
        assert (answer.status_code, answer.headers["allow"]) == (405, "POST")
    matrix = {"name": "estimate", "hands": ["allegro"], "objects": ["mug"]}
    assert http.post("/v1/datasets", json=matrix).status_code == 422, "no dataset takes its name"
