"""What the keys of a project may use together: grasps in work, grasps of a day, and GPU seconds of a day."""

from collections.abc import Callable
from typing import Any

import pytest
from sqlalchemy import update
from starlette.testclient import TestClient

from graspd.api.access.keys import KeyFile, ProjectLimits, Scope
from graspd.service.index.tables import shards
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from tests.api.conftest import TODAY
from tests.api.factories import bearer, finish_all, people_of
from tests.fakes import record_of

JOB = {"hand": "allegro", "object": "mug", "grasps": 32}
Ask = Callable[..., Any]


@pytest.fixture
def service(make_twins: Callable[[], list[TestClient]]) -> TestClient:
    return make_twins()[0]


@pytest.fixture
def ask(service: TestClient, settings: Settings) -> Ask:
    """Submits a job in the name of a key: two are of `red`, one of `blue`."""
    projects = {"ann": "red", "amy": "red", "bob": "blue"}
    people = people_of(settings, **{name: (Scope.SUBMIT, project) for name, project in projects.items()})

    def submit(who: str, seed: int, path: str = "/v1/jobs", /, **changes: Any) -> Any:
        body = {**JOB, "seed": seed, **changes} if path == "/v1/jobs" else changes
        return service.post(path, json=body, headers=people[who])

    return submit


def limit(settings: Settings, **limits: int) -> None:
    KeyFile(settings.resolved_keys_file).limit_project("red", ProjectLimits(**limits))


def done(services: Services, job: str, *, seconds: float, device: str = "cuda:0", day: str = TODAY) -> None:
    (made,) = finish_all(services, record_of(services, job))
    values = {"device": device, "created": f"{day}T11:00:00.000000Z", "seconds": seconds}
    with services.index.database.write_transaction() as connection:
        connection.execute(update(shards).where(shards.c.id == made.shard_id).values(**values))


def refused(answer: Any) -> str:
    assert answer.status_code == 429 and answer.json()["type"] == "/problems/quota-exceeded", answer.text
    return str(answer.json()["detail"])


def test_keys_of_a_project_share_its_grasps_in_work(ask: Ask, settings: Settings, services: Services) -> None:
    limit(settings, grasps_in_flight=64)
    first = ask("ann", 1).json()["id"]
    assert ask("amy", 2).status_code == 202
    assert "the project 'red' has 64 grasps in unfinished jobs, and at most 64 are allowed" in refused(ask("amy", 3))
    assert ask("bob", 3).status_code == 202
    finish_all(services, record_of(services, first))
    assert ask("amy", 3).status_code == 202, "one of ann's ended"


def test_keys_of_a_project_share_its_grasps_of_a_day(ask: Ask, settings: Settings, services: Services) -> None:
    limit(settings, grasps_per_day=96)
    first = ask("ann", 1).json()["id"]
    finish_all(services, record_of(services, first))
    too_many = ask("amy", 2, grasps=65)
    assert "has requested 32 of 96 grasps allowed per day" in refused(too_many), "also for what is done"
    assert 12 * 3600 <= int(too_many.headers["retry-after"]) <= 12 * 3600 + 1, "until midnight, and not before"
    matrix = {"name": "d", "hands": ["allegro"], "objects": ["mug", "bottle"], "grasps": 32}
    assert ask("amy", 0, "/v1/datasets", **matrix | {"grasps": 33}).status_code == 429
    assert ask("amy", 0, "/v1/datasets", **matrix).status_code == 202
    assert "has requested 96 of 96" in refused(ask("ann", 2))
    assert ask("bob", 2).status_code == 202


def test_a_project_without_gpu_seconds_left_submits_no_more(ask: Ask, settings: Settings, services: Services) -> None:
    limit(settings, gpu_seconds_per_day=60)
    made = [ask("ann", seed).json()["id"] for seed in (1, 2)]
    waiting = ask("ann", 3).json()["id"]

    done(services, made[0], device="cpu", seconds=61.0)
    done(services, ask("ann", 4).json()["id"], day="2026-11-19", seconds=61.0)
    assert ask("amy", 5).status_code == 202, "neither a CPU's time nor yesterday's counts"
    done(services, made[1], seconds=61.0)
    assert "the project 'red' has used 61 of the 60 GPU seconds allowed per day" in refused(ask("amy", 6))
    assert ask("bob", 6).status_code == 202
    assert not services.index.jobs.get(waiting).state.is_final, "what was submitted before goes on"


def test_usage_is_of_the_own_project(ask: Ask, service: TestClient, settings: Settings, services: Services) -> None:
    for name, seed in (("ann", 1), ("bob", 2)):
        done(services, ask(name, seed).json()["id"], seconds=2.5)
    keys = KeyFile(settings.resolved_keys_file)
    reader, admin = keys.add("reader", Scope.READ, project="red"), keys.add("root", Scope.ADMIN)

    def read(path: str, token: str) -> Any:
        return service.get(path, params={"since": TODAY, "until": TODAY}, headers=bearer(token))

    (own,) = read("/v1/usage", reader).json()
    assert (own["project"], own["day"], own["grasps"], own["gpu_seconds"]) == ("red", TODAY, 32, 2.5)
    lines = read("/v1/usage.csv", reader).text.splitlines()
    assert lines == [",".join(own), ",".join(str(value) for value in own.values())]
    assert {day["project"] for day in read("/v1/usage", admin).json()} == {"red", "blue"}
