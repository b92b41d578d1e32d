"""Rights of keys: who may cancel, retry and delete what, and what the keys of a project may use together."""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from typing import Any

import pytest
from httpx import Response
from sqlalchemy import update
from starlette.testclient import TestClient

from graspd.api.access.auth import ForeignResource, caller, require_ownership
from graspd.api.access.keys import Key, KeyFile, ProjectLimits, Scope
from graspd.api.app import create_app
from graspd.service.index.tables import shards
from graspd.service.model.states import State
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from graspd.service.store.network_file import to_bytes
from tests.api.conftest import TODAY
from tests.api.factories import bearer, finish_all, people_of
from tests.fakes import plan_all, record_of
from tests.networks import random_network

JOB = {"hand": "allegro", "object": "mug", "grasps": 32}
MATRIX = {"name": "d", "hands": ["allegro"], "objects": ["mug"], "grasps": 32}
Ask = Callable[..., Response]
#: Who may change what ann submitted.
WHO = pytest.mark.parametrize(("who", "may"), [("ann", True), ("bob", False), ("eve", False), ("root", True)])


@pytest.fixture
def ask(settings: Settings, services: Services) -> Iterator[Ask]:
    """Sends a request in the name of somebody: two may submit, one may read, and one may do all."""
    scopes = {"ann": Scope.SUBMIT, "bob": Scope.SUBMIT, "eve": Scope.READ, "root": Scope.ADMIN}
    people = people_of(settings, **{name: (scope, "") for name, scope in scopes.items()})
    with TestClient(create_app(settings, services), base_url="https://graspd.example") as client:

        def send(who: str | dict[str, str], method: str, path: str, **content: Any) -> Response:
            headers = people[who] if isinstance(who, str) else who
            return client.request(method, path, headers=headers, **content)

        yield send


def submitted(ask: Ask, who: str) -> str:
    return str(ask(who, "POST", "/v1/jobs", json=JOB).json()["id"])


@WHO
def test_a_job_is_changed_by_its_key_or_an_admin(ask: Ask, services: Services, who: str, may: bool) -> None:
    job = submitted(ask, "ann")
    path = f"/v1/jobs/{job}"
    assert ask("root", "DELETE", path).status_code == 409, "it has not ended"
    assert ask(who, "POST", f"{path}/cancel").status_code == (202 if may else 403)
    assert (ask("eve", "GET", path).json()["state"] == "cancelled") is may
    ask("ann", "POST", f"{path}/cancel")
    assert ask(who, "POST", f"{path}/retry").status_code == (202 if may else 403)
    ask("ann", "POST", f"{path}/cancel")
    assert ask(who, "DELETE", path).status_code == (204 if may else 403)
    assert ask("eve", "GET", path).status_code == (404 if may else 200)


@WHO
def test_a_dataset_is_changed_by_its_key_or_an_admin(ask: Ask, services: Services, who: str, may: bool) -> None:
    ask("ann", "POST", "/v1/datasets", json=MATRIX)
    for action in ("cancel", "retry"):
        assert may or ask(who, "POST", f"/datasets/d/{action}").status_code == 403
    assert may or ask(who, "POST", "/v1/datasets/d/retry").status_code == 403
    assert ask(who, "POST", "/v1/datasets/d/cancel").status_code == (202 if may else 403)
    ask("ann", "POST", "/v1/datasets/d/cancel")
    plan_all(services)
    assert ask(who, "DELETE", "/v1/datasets/d").status_code == (204 if may else 403)
    ask("root", "DELETE", "/v1/datasets/d")
    assert [one["name"] for one in ask("ann", "GET", "/v1/deletions").json()] == ["d"]
    assert ask(who, "POST", "/v1/datasets/d/restore").status_code == (200 if may else 403)
    assert ask("eve", "GET", "/v1/datasets/d").status_code == (200 if may else 404)


def test_a_shared_job_survives_the_end_of_another_keys_dataset(ask: Ask, services: Services) -> None:
    job = submitted(ask, "ann")
    assert submitted(ask, "bob") == job
    assert ask("bob", "POST", f"/v1/jobs/{job}/cancel").status_code == 403, "he only found it"
    ask("bob", "POST", "/v1/datasets", json=MATRIX | {"objects": ["mug", "bottle"]})
    assert ask("bob", "DELETE", "/v1/datasets/d").status_code == 409, "it has not ended"
    plan_all(services)
    assert ask("bob", "POST", "/v1/datasets/d/cancel").status_code == 202
    plan_all(services)
    states = {cell.job_id == job: cell.state for cell in services.index.datasets.cells("d").items}
    assert states == {True: State.QUEUED, False: State.CANCELLED}


def test_jobs_of_a_dataset_belong_to_its_key(ask: Ask, services: Services) -> None:
    ask("ann", "POST", "/v1/datasets", json=MATRIX)
    plan_all(services)
    job = services.index.datasets.cells("d").items[0].job_id
    assert ask("bob", "POST", f"/v1/jobs/{job}/cancel").status_code == 403
    assert ask("ann", "POST", f"/v1/jobs/{job}/cancel").status_code == 202


def test_a_rotated_key_keeps_its_jobs_and_a_later_one_has_none(ask: Ask, keys: KeyFile) -> None:
    job, other = submitted(ask, "ann"), bearer(keys.rotate("ann"))
    assert ask(other, "POST", f"/v1/jobs/{job}/cancel").status_code == 202
    keys.revoke("ann")
    assert ask(bearer(keys.add("ann", Scope.SUBMIT)), "POST", f"/v1/jobs/{job}/retry").status_code == 403


def test_keys_of_before_there_were_ids_have_one_through_rotation(keys: KeyFile) -> None:
    old = {"name": "ann", "scope": "submit", "sha256": "a" * 64, "created": "2026-01-01T00:00:00Z"}
    key, again = Key.model_validate(old), Key.model_validate(old | {"sha256": "b" * 64, "created": "2026-02-01"})
    assert key.id and key.id == again.id and key.id != Key.model_validate(old | {"name": "bob"}).id


@pytest.mark.parametrize(("scope", "passes"), [(Scope.READ, False), (Scope.SUBMIT, False), (Scope.ADMIN, True)])
def test_what_has_no_owner_is_changed_by_an_admin_alone(scope: Scope, passes: bool) -> None:
    token = caller.set(Key(id="1", name="me", scope=scope, sha256="", created=""))
    refused = pytest.raises(ForeignResource, match=r"hand 'mine'.*'me'.*admin")
    try:
        with nullcontext() if passes else refused:
            require_ownership("", "hand 'mine'")
    finally:
        caller.reset(token)


@WHO
def test_pages_show_a_button_only_to_whom_it_would_serve(ask: Ask, who: str, may: bool) -> None:
    job = submitted(ask, "ann")
    ask("ann", "POST", "/v1/datasets", json=MATRIX)
    for page, action in ((f"/jobs/{job}", f"/jobs/{job}/cancel"), ("/datasets/d", "/datasets/d/cancel")):
        assert (f'action="{action}"' in ask(who, "GET", page).text) is may
    page, submits = ask(who, "GET", "/datasets").text, who != "eve"
    assert ('action="/datasets"' in page, 'value="cancel"' in page, 'href="/submit"' in page) == (submits,) * 3


def test_chosen_jobs_of_others_are_counted_as_left(ask: Ask) -> None:
    job = submitted(ask, "ann")
    chosen = {"action": "cancel", "cell": "allegro|mug"}
    assert "0 jobs cancelled. 1 unchanged" in ask("bob", "POST", "/datasets/cells", data=chosen).text
    assert ask("bob", "GET", f"/v1/jobs/{job}").json()["state"] == "queued"


@WHO
def test_objects_networks_and_sets_are_changed_by_their_key(ask: Ask, who: str, may: bool) -> None:
    def put(who: str, *objects: str) -> int:
        return ask(who, "POST", "/v1/object-sets", json={"name": "s", "objects": objects}).status_code

    file = {"file": ("net.npz", to_bytes(random_network()))}
    assert ask("eve", "POST", "/v1/networks", files=file).status_code == 403, "a reader adds none"
    ask("ann", "POST", "/v1/networks", files=file)
    ask("ann", "POST", "/v1/objects", files={"file": ("box.stl", b"solid")})
    for address in ("/v1/objects/box", "/v1/networks/net"):
        assert ask(who, "DELETE", address).status_code == (204 if may else 403)
    built_in = ask(who, "DELETE", "/v1/objects/mug").status_code
    assert built_in == (403 if who == "eve" else 409), "it comes with graspd"
    assert put("ann", "mug") == put("root", "mug") == 201
    assert put(who, "mug", "block") == (201 if may else 403)
    assert ("block" in ask("eve", "GET", "/v1/object-sets/s").json()["objects"]) is may
    assert put("ann", "block") == 201


Submit = Callable[..., Any]


@pytest.fixture
def service(make_twins: Callable[[], list[TestClient]]) -> TestClient:
    return make_twins()[0]


@pytest.fixture
def submitting(service: TestClient, settings: Settings) -> Submit:
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


def test_keys_of_a_project_share_its_grasps_in_work(submitting: Submit, settings: Settings, services: Services) -> None:
    limit(settings, grasps_in_flight=64)
    first = submitting("ann", 1).json()["id"]
    assert submitting("amy", 2).status_code == 202
    assert "the project 'red' has 64 grasps in unfinished jobs, and at most 64 are allowed" in refused(
        submitting("amy", 3)
    )
    assert submitting("bob", 3).status_code == 202
    finish_all(services, record_of(services, first))
    assert submitting("amy", 3).status_code == 202, "one of ann's ended"


def test_keys_of_a_project_share_its_grasps_of_a_day(
    submitting: Submit, settings: Settings, services: Services
) -> None:
    limit(settings, grasps_per_day=96)
    finish_all(services, record_of(services, submitting("ann", 1).json()["id"]))
    too_many = submitting("amy", 2, grasps=65)
    assert "has requested 32 of 96 grasps allowed per day" in refused(too_many), "also for what is done"
    assert 12 * 3600 <= int(too_many.headers["retry-after"]) <= 12 * 3600 + 1, "until midnight, and not before"
    matrix = {"name": "d", "hands": ["allegro"], "objects": ["mug", "bottle"], "grasps": 32}
    assert submitting("amy", 0, "/v1/datasets", **matrix | {"grasps": 33}).status_code == 429
    assert submitting("amy", 0, "/v1/datasets", **matrix).status_code == 202
    assert "has requested 96 of 96" in refused(submitting("ann", 2))
    assert submitting("bob", 2).status_code == 202


def test_a_project_without_gpu_seconds_left_submits_no_more(
    submitting: Submit, settings: Settings, services: Services
) -> None:
    limit(settings, gpu_seconds_per_day=60)
    made = [submitting("ann", seed).json()["id"] for seed in (1, 2)]
    waiting = submitting("ann", 3).json()["id"]

    done(services, made[0], device="cpu", seconds=61.0)
    done(services, submitting("ann", 4).json()["id"], day="2026-11-19", seconds=61.0)
    assert submitting("amy", 5).status_code == 202, "neither a CPU's time nor yesterday's counts"
    done(services, made[1], seconds=61.0)
    assert "the project 'red' has used 61 of the 60 GPU seconds allowed per day" in refused(submitting("amy", 6))
    assert submitting("bob", 6).status_code == 202
    assert not services.index.jobs.get(waiting).state.is_final, "what was submitted before goes on"


def test_usage_is_of_the_own_project(
    submitting: Submit, service: TestClient, settings: Settings, services: Services
) -> None:
    for name, seed in (("ann", 1), ("bob", 2)):
        done(services, submitting(name, seed).json()["id"], seconds=2.5)
    keys = KeyFile(settings.resolved_keys_file)
    reader, admin = keys.add("reader", Scope.READ, project="red"), keys.add("root", Scope.ADMIN)

    def read(path: str, token: str) -> Any:
        return service.get(path, params={"since": TODAY, "until": TODAY}, headers=bearer(token))

    (own,) = read("/v1/usage", reader).json()
    assert (own["project"], own["day"], own["grasps"], own["gpu_seconds"]) == ("red", TODAY, 32, 2.5)
    lines = read("/v1/usage.csv", reader).text.splitlines()
    assert lines == [",".join(own), ",".join(str(value) for value in own.values())]
    assert {day["project"] for day in read("/v1/usage", admin).json()} == {"red", "blue"}
