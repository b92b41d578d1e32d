"""Answers that are as the OpenAPI document and RFC 9110 say, where the walk of all operations does not look."""

from __future__ import annotations

import pytest
from starlette.testclient import TestClient


@pytest.mark.parametrize("day", ["0", "86400", "2026-01-31T00:00:00", "20260131", "2026-1-31", "2026-02-30"])
@pytest.mark.parametrize("name", ["since", "until"])
@pytest.mark.parametrize("path", ["/v1/usage", "/v1/usage.csv", "/usage"])
def test_a_day_is_a_full_date_and_nothing_else(http: TestClient, path: str, name: str, day: str) -> None:
    assert http.get(path, params={name: day}).status_code == 422


@pytest.mark.parametrize("path", ["/v1/usage", "/v1/usage.csv", "/usage"])
def test_a_day_is_taken(http: TestClient, path: str) -> None:
    assert http.get(path, params={"since": "2026-01-30", "until": "2026-01-31"}).status_code == 200


@pytest.mark.parametrize("method", ["GET", "HEAD", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE", "PROPFIND"])
def test_an_estimate_names_the_one_method_that_works(http: TestClient, method: str) -> None:
    answer = http.request(method, "/v1/datasets/estimate")
    assert (answer.status_code, answer.headers["allow"]) == (405, "POST")
