"""Tables of jobs, datasets and their estimates on a terminal."""

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console
from typer.testing import CliRunner

from graspd.cli import build_app
from graspd.client.reports import JobDisplay, print_cells, print_dataset, print_estimate
from graspd.service.cli import plain_console
from graspd.service.model.domain import JobOptions
from graspd.service.model.states import State
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.cost import estimate
from graspd.service.pipeline.datasets.spec import DatasetRequest
from tests.api.factories import add_job, finish_all
from tests.fakes import plan_all

#: Markup, were it not shown as it is.
NAME = "[red]mug[/] :mug: " + "a-very-long-name-of-an-object-that-somebody-gave-to-it"[:46]
ID = "0123456789ab"
CREATED = "2026-11-26T03:14:11.123456Z"
_DONE = {"state": State.SUCCEEDED, "progress": 1.0, "created": CREATED, "model_dump": dict}
_JOB = {"id": ID + "0" * 20, "hand": NAME, "object": NAME, "standing": "valid"}
JOB = SimpleNamespace(**dict.fromkeys(("valid", "grasps", "requested"), 100_000), **_JOB, **_DONE)
_DATASET = {"name": NAME, "cells": 1000, "counted_grasps": 10**6, "asked": 10**6, "size_bytes": 10**9 + 1}
DATASET = SimpleNamespace(**_DATASET, **_DONE, options=JobOptions())
_UPLOAD = {"name": NAME, "filename": NAME, "size_bytes": 10**6, "builtin": False, "verdict": "ok", "facts": {}}
ASSET = SimpleNamespace(**_UPLOAD, digest=ID + "0" * 52, model_dump=dict)
TAG = {"name": NAME, "grasps": 10**6, "changed": CREATED}
WEBHOOK = {"id": ID, "url": "https://example.org/" + NAME, "states": ["failed", "succeeded"], "created": CREATED}
_ENDED = {"kind": "job", "subject": ID, "ended": "succeeded", "state": "delivered"}
DELIVERY = _ENDED | {"attempts": 3, "tried": CREATED, "detail": NAME}


class Service:
    """Answers each list with one row."""

    def jobs(self, **_: Any) -> Any:
        return SimpleNamespace(items=[JOB], next=None)

    def assets(self, _: Any, **__: Any) -> Iterator[Any]:
        yield ASSET

    def send(self, _: str, path: str) -> Any:
        rows = TAG if path.endswith("tags") else DELIVERY if path.endswith("deliveries") else WEBHOOK
        return SimpleNamespace(json=lambda: [rows])

    def datasets(self, **_: Any) -> Any:
        return SimpleNamespace(items=[DATASET], next=None)


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    @contextmanager
    def opened(_: str | None) -> Iterator[Service]:
        yield Service()

    monkeypatch.setattr("graspd.client.reports.open_client", opened)

    def run(*arguments: str) -> list[str]:
        done = CliRunner().invoke(build_app(), arguments, env={"COLUMNS": "80"})
        assert done.exit_code == 0, done.output
        return done.stdout.splitlines()

    return run


@pytest.mark.parametrize(
    ("command", "whole"),
    [
        ("jobs", [ID, "succeeded", "2026-11-26 03:14"]),
        ("datasets list", ["succeeded", "2026-11-26 03:14", "1.0 GB"]),
        ("hands list", [ID]),
        ("tags list", ["2026-11-26 03:14", "1,000,000"]),
        ("webhooks list", [ID, "2026-11-26 03:14"]),
        ("webhooks log 1", ["succeeded", "delivered", "2026-11-26 03:14"]),
    ],
)
def test_a_table_of_80_columns_cuts_nothing(shown: Any, command: str, whole: list[str]) -> None:
    lines = shown(*command.split())
    assert max(map(len, lines)) <= 80 and "…" not in "".join(lines)
    assert all(any(text in line for line in lines) for text in whole), lines
    # Broken, in whichever column, but every letter of it is there.
    letters = "".join(sorted("".join("".join(lines).split())))
    assert all(letters.count(letter) >= NAME.count(letter) for letter in set(NAME) - {" "})


def test_progress_shows_messages_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    console = plain_console()
    monkeypatch.setattr(type(console), "is_terminal", True)
    display = JobDisplay(console)
    display.add_task("render", total=1, message="[red]mug[/] [/nothing]", rate="")
    with console.capture() as got:
        console.print(display)
    assert "[red]mug[/] [/nothing]" in got.get()


@pytest.mark.parametrize("validation", ["none", "standard"])
def test_a_report_names_the_standing_of_what_it_counts(services: Services, validation: str) -> None:
    given = {"name": "k", "hands": ["allegro"], "objects": ["mug"], "grasps": 32, "validation": validation}
    wanted = DatasetRequest.model_validate(given)
    actions.create(services, wanted)
    plan_all(services)
    finish_all(services, add_job(services, validation=validation))
    out = io.StringIO()
    console = Console(file=out, width=200)
    dataset = services.index.datasets.get("k")
    print_estimate(estimate(services.index, wanted), console)
    print_dataset(dataset, console)
    print_cells(dataset, services.index.datasets.cells("k").items, console)
    made = 32 if validation == "none" else dataset.valid
    word, other = ("feasible", "valid") if validation == "none" else ("valid", "feasible")
    assert f"grasps: {made} {word} of 32 candidates" in out.getvalue()
    validated = "not validated" if validation == "none" else "at"
    assert f"per {word} grasp" in out.getvalue() and f"{made}/32 {validated}" in out.getvalue()
    assert not re.search(rf"\b{other}\b", out.getvalue())
    assert JobOptions(want="candidates", validation="none").displayed_status == "kept"
    reasons = [line for line in out.getvalue().splitlines() if line.startswith("reason: ")]
    assert reasons == ([] if validation == "none" else [f"reason: {dataset.reason}"])
