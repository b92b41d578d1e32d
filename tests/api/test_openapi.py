"""The OpenAPI document tells the truth about errors, and the overview names commands that exist."""

from __future__ import annotations

import pytest
import typer
from starlette.testclient import TestClient
from typer.core import TyperGroup

import graspd.cli
from tests.conftest import REPOSITORY


def operations(http: TestClient) -> dict[str, dict[str, object]]:
    paths = http.get("/openapi.json").json()["paths"]
    return {f"{method} {path}": operation for path, methods in paths.items() for method, operation in methods.items()}


def test_every_error_is_declared_as_a_problem_document(http: TestClient) -> None:
    for name, operation in operations(http).items():
        for status, answer in operation["responses"].items():  # type: ignore[attr-defined]
            if status.startswith("4"):
                assert set(answer["content"]) == {"application/problem+json"}, f"{name} {status}"


def test_everything_below_v1_declares_that_a_key_may_be_needed(http: TestClient) -> None:
    missing = [
        name
        for name, operation in operations(http).items()
        if "/v1/" in name and "401" not in operation["responses"]  # type: ignore[operator]
    ]
    assert missing == []


def test_the_page_of_the_api_lists_every_route(http: TestClient) -> None:
    page = (REPOSITORY / "docs" / "reference" / "http.md").read_text()
    assert [path for path in http.get("/openapi.json").json()["paths"] if f"`{path}`" not in page] == []


def test_no_reference_in_the_document_is_open(http: TestClient) -> None:
    text = http.get("/openapi.json").text
    schemas = http.get("/openapi.json").json()["components"]["schemas"]
    wanted = {part.partition('"')[0] for part in text.split("#/components/schemas/")[1:]}
    assert wanted <= set(schemas)


@pytest.mark.parametrize("name", [name for name, module, _, _ in graspd.cli.COMMANDS if module != "graspd.demo"])
def test_every_command_of_the_overview_opens(name: str) -> None:
    module = next(module for known, module, _, _ in graspd.cli.COMMANDS if known == name)
    root = typer.main.get_command(graspd.cli.build())
    assert isinstance(root, TyperGroup)
    assert graspd.cli.load(module, name) is not None
