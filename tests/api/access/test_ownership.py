"""Who may cancel, retry and delete what: the key that submitted it, or an admin's."""

from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext
from typing import Any

import pytest
from httpx import Response
from starlette.testclient import TestClient

from graspd.api.access.auth import ForeignResource, caller, require_ownership
from graspd.api.access.keys import Key, KeyFile, Scope
from graspd.api.app import create_app
from graspd.service.index.index import Index
from graspd.service.index.rebuild import rebuild
from graspd.service.model.states import AssetKind, State
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from graspd.service.store.network_file import to_bytes
from tests.api.factories import bearer, people_of
from tests.fakes import plan_all
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
    later = bearer(keys.add("ann", Scope.SUBMIT))
    assert ask(later, "POST", f"/v1/jobs/{job}/retry").status_code == 403


def test_keys_of_before_there_were_ids_have_one_through_rotation(keys: KeyFile) -> None:
    old = {"name": "ann", "scope": "submit", "sha256": "a" * 64, "created": "2026-01-01T00:00:00Z"}
    key, again = Key.model_validate(old), Key.model_validate(old | {"sha256": "b" * 64, "created": "2026-02-01"})
    assert key.id and key.id == again.id and key.id != Key.model_validate(old | {"name": "bob"}).id


def test_owners_are_in_the_store_and_survive_a_lost_index(ask: Ask, services: Services, keys: KeyFile) -> None:
    ann = next(key.id for key in keys.list() if key.name == "ann")
    job = submitted(ask, "ann")
    ask("ann", "POST", "/v1/datasets", json=MATRIX)
    file = ("ball.stl", b"solid ball\nendsolid ball\n")
    added = ask("ann", "POST", "/v1/objects", files={"file": file})
    assert added.status_code == 202
    with closing(Index("sqlite://")) as fresh:
        rebuild(fresh, services.store)
        found = fresh.jobs.get(job), fresh.datasets.get("d"), fresh.assets.get(AssetKind.OBJECT, "ball")
        assert [one.owner for one in found] == [ann, ann, ann]


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
    answer = ask("bob", "POST", "/datasets/cells", data=chosen, follow_redirects=False)
    assert "done=0&left=1" in answer.headers["location"]
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
    held = ask("eve", "GET", "/v1/object-sets/s").json()["objects"]
    assert ("block" in held) is may
    assert put("ann", "block") == 201
