"""Conditional requests and HEAD on downloads (RFC 9110), methods of an address, framing of bodies."""

from __future__ import annotations

import pytest
from fastapi import FastAPI
from httpx import Response
from starlette.testclient import TestClient

from graspd.service.pipeline.backends import Services
from tests.api.factories import add_job, finish_all


@pytest.fixture
def file(http: TestClient, services: Services) -> str:
    return f"/v1/shards/{finish_all(services, add_job(services))[0].shard_id}/file"


@pytest.fixture
def model(services: Services) -> str:
    return "/v1/hands/allegro/model"


@pytest.mark.parametrize("what", ["file", "model"])
@pytest.mark.parametrize("form", ["{}", "W/{}", '"other", {}', "*", '"other"'])
@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_what_a_client_has_is_not_sent_again(
    http: TestClient, request: pytest.FixtureRequest, what: str, form: str, method: str
) -> None:
    address = request.getfixturevalue(what)
    etag = http.get(address).headers["etag"]
    answer = http.request(method, address, headers={"If-None-Match": form.format(etag), "Range": "bytes=0-9"})
    if form == '"other"':
        assert answer.is_success
        return
    assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", etag)
    assert "cache-control" in answer.headers


@pytest.mark.parametrize("validator", ["{}", '"other"', "W/{}", "Sat, 21 Nov 2026 00:00:00 GMT"])
def test_half_a_file_is_completed_only_where_it_is_the_same(http: TestClient, file: str, validator: str) -> None:
    whole = http.get(file)
    answer = http.get(file, headers={"Range": "bytes=100-", "If-Range": validator.format(whole.headers["etag"])})
    wanted = (206, whole.content[100:]) if validator == "{}" else (200, whole.content)
    assert (answer.status_code, answer.content) == wanted


@pytest.mark.parametrize("what", ["file", "model"])
def test_head_says_what_get_would_and_sends_nothing(
    http: TestClient, request: pytest.FixtureRequest, what: str
) -> None:
    address = request.getfixturevalue(what)
    whole, head = http.get(address), http.head(address, headers={"Range": "bytes=0-9"})
    assert (head.status_code, head.content) == (200, b"")
    same = ("content-length", "content-type", "etag", "cache-control", "accept-ranges")
    assert {name: head.headers.get(name) for name in same} == {name: whole.headers.get(name) for name in same}


def test_a_body_of_two_lengths_ends_the_connection(http: TestClient) -> None:
    both = {"Transfer-Encoding": "chunked", "Content-Length": "2"}
    answer = http.post("/v1/jobs", content=b"{}", headers=both)
    assert (answer.status_code, answer.headers["connection"]) == (400, "close")


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


@pytest.mark.parametrize("encoding", ["gzip", "zstd", "gzip, br"])
def test_an_encoded_body_is_refused_by_its_encoding(http: TestClient, encoding: str) -> None:
    for method, path in (("POST", "/v1/jobs"), ("POST", "/submit"), ("DELETE", "/v1/jobs/x")):
        answer = http.request(method, path, content=b"x", headers={"Content-Encoding": encoding})
        assert (answer.status_code, answer.headers["accept-encoding"]) == (415, "identity")
        assert encoding in answer.text
    assert http.post("/v1/jobs", json={}, headers={"Content-Encoding": "identity"}).status_code == 422


@pytest.mark.parametrize("path", ["/v1/usage", "/v1/usage.csv", "/usage"])
def test_a_day_is_a_full_date_and_nothing_else(http: TestClient, path: str) -> None:
    assert http.get(path, params={"since": "2026-01-30", "until": "2026-01-31"}).status_code == 200
    for day in ("0", "86400", "2026-01-31T00:00:00", "20260131", "2026-1-31", "2026-02-30"):
        for name in ("since", "until"):
            assert http.get(path, params={name: day}).status_code == 422, (name, day)


@pytest.mark.parametrize("method", ["GET", "HEAD", "PUT", "OPTIONS", "PROPFIND"])
def test_an_estimate_names_the_one_method_that_works(http: TestClient, method: str) -> None:
    answer = http.request(method, "/v1/datasets/estimate")
    assert (answer.status_code, answer.headers["allow"]) == (405, "POST")
    matrix = {"name": "estimate", "hands": ["allegro"], "objects": ["mug"]}
    assert http.post("/v1/datasets", json=matrix).status_code == 422, "no dataset takes its name"
