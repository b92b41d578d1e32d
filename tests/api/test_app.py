"""The application as a whole."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import TypeAdapter
from starlette.testclient import TestClient

from graspd.api.app import create_app
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/datasets", "/", "/healthz"])
def test_the_first_request_builds_no_route(
    settings: Settings, services: Services, path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = create_app(settings, services)

    def built_late(self: TypeAdapter[Any], *arguments: Any, **named: Any) -> None:
        raise AssertionError("a field of a route is built while a request waits")

    monkeypatch.setattr(TypeAdapter, "__init__", built_late)
    with TestClient(app, base_url="http://127.0.0.1:8000") as client:
        assert client.get(path).is_success
