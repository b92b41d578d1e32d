"""Who may cancel, retry and delete what: the key that submitted it, or an admin's."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from starlette.testclient import TestClient

from graspd.api.access.auth import ForeignResource, caller, must_own
from graspd.api.access.keys import Key, KeyFile, Scope
from graspd.api.app import create_app
from graspd.service.index.index import Index
from graspd.service.index.rebuild import rebuild
from graspd.service.model.states import AssetKind, State
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from graspd.service.store.network_file import to_bytes
from tests.api.factories import add_job, bearer, people_of
from tests.networks import random_network
from tests.planning import plan_all

JOB = {"hand": "allegro", "object": "mug", "grasps": 32}
MATRIX = {"name": "d", "hands": ["allegro"], "objects": ["mug"], "grasps": 32}
Headers = dict[str, str]


@pytest.fixture
def keys(settings: Settings) -> KeyFile:
    return KeyFile(settings.resolved_keys_file)


@pytest.fixture
def people(settings: Settings) -> dict[str, Headers]:
    """Headers of two keys that may submit, of one that may read and of one that may all."""
    scopes = {"ann": Scope.SUBMIT, "bob": Scope.SUBMIT, "eve": Scope.READ, "root": Scope.ADMIN}
    return people_of(settings, **{name: (scope, "") for name, scope in scopes.items()})


#: Who may change what ann submitted.
WHO = pytest.mark.parametrize(("who", "may"), [("ann", True), ("bob", False), ("eve", False), ("root", True)])


@pytest.fixture
def client(people: dict[str, Headers], settings: Settings, services: Services) -> Iterator[TestClient]:
    with TestClient(create_app(settings, services), base_url="https://graspd.example") as opened:
        yield opened


def submitted(client: TestClient, headers: Headers) -> str:
    return str(client.post("/v1/jobs", json=JOB, headers=headers).json()["id"])


@WHO
def test_a_job_is_changed_by_its_key_or_an_admin(
    client: TestClient, people: dict[str, Headers], services: Services, who: str, may: bool
) -> None:
    job = submitted(client, people["ann"])
    path = f"/v1/jobs/{job}"
    assert client.delete(path, headers=people["root"]).status_code == 409, "it has not ended"
    assert client.post(f"{path}/cancel", headers=people[who]).status_code == (202 if may else 403)
    assert (client.get(path, headers=people["eve"]).json()["state"] == "cancelled") is may
    client.post(f"{path}/cancel", headers=people["ann"])
    assert client.post(f"{path}/retry", headers=people[who]).status_code == (202 if may else 403)
    client.post(f"{path}/cancel", headers=people["ann"])
    assert client.delete(path, headers=people[who]).status_code == (204 if may else 403)
    assert client.get(path, headers=people["eve"]).status_code == (404 if may else 200)


@pytest.mark.parametrize("action", ["cancel", "retry"])
@pytest.mark.parametrize("prefix", ["/v1/datasets", "/datasets"])
def test_a_dataset_of_another_key_is_left_alone(
    client: TestClient, people: dict[str, Headers], prefix: str, action: str
) -> None:
    client.post("/v1/datasets", json=MATRIX, headers=people["ann"])
    assert client.post(f"{prefix}/d/{action}", headers=people["bob"]).status_code == 403
    assert client.get("/v1/datasets/d", headers=people["bob"]).json()["cancelled"] is False


@WHO
def test_a_dataset_is_changed_by_its_key_or_an_admin(
    client: TestClient, people: dict[str, Headers], services: Services, who: str, may: bool
) -> None:
    client.post("/v1/datasets", json=MATRIX, headers=people["ann"])
    assert client.post("/v1/datasets/d/cancel", headers=people[who]).status_code == (202 if may else 403)
    client.post("/v1/datasets/d/cancel", headers=people["ann"])
    plan_all(services)
    assert client.delete("/v1/datasets/d", headers=people[who]).status_code == (204 if may else 403)
    client.delete("/v1/datasets/d", headers=people["root"])
    assert [one["name"] for one in client.get("/v1/deletions", headers=people["ann"]).json()] == ["d"]
    assert client.post("/v1/datasets/d/restore", headers=people[who]).status_code == (200 if may else 403)
    assert client.get("/v1/datasets/d", headers=people["eve"]).status_code == (200 if may else 404)


def test_a_shared_job_survives_the_end_of_another_keys_dataset(
    client: TestClient, people: dict[str, Headers], services: Services
) -> None:
    job = submitted(client, people["ann"])
    assert submitted(client, people["bob"]) == job
    assert client.post(f"/v1/jobs/{job}/cancel", headers=people["bob"]).status_code == 403, "he only found it"
    client.post("/v1/datasets", json=MATRIX | {"objects": ["mug", "bottle"]}, headers=people["bob"])
    assert client.delete("/v1/datasets/d", headers=people["bob"]).status_code == 409, "it has not ended"
    plan_all(services)
    assert client.post("/v1/datasets/d/cancel", headers=people["bob"]).status_code == 202
    plan_all(services)
    states = {cell.job_id == job: cell.state for cell in services.index.datasets.cells("d").items}
    assert states == {True: State.QUEUED, False: State.CANCELLED}


def test_jobs_of_a_dataset_belong_to_its_key(
    client: TestClient, people: dict[str, Headers], services: Services
) -> None:
    client.post("/v1/datasets", json=MATRIX, headers=people["ann"])
    plan_all(services)
    job = services.index.datasets.cells("d").items[0].job_id
    assert client.post(f"/v1/jobs/{job}/cancel", headers=people["bob"]).status_code == 403
    assert client.post(f"/v1/jobs/{job}/cancel", headers=people["ann"]).status_code == 202


def test_a_job_from_before_there_were_keys_takes_an_admin(
    client: TestClient, people: dict[str, Headers], services: Services
) -> None:
    old = add_job(services, seed=7).id
    assert client.post(f"/v1/jobs/{old}/cancel", headers=people["ann"]).status_code == 403
    assert client.post(f"/v1/jobs/{old}/cancel", headers=people["root"]).status_code == 202


def test_a_rotated_key_keeps_its_jobs_and_a_later_one_has_none(
    client: TestClient, people: dict[str, Headers], keys: KeyFile
) -> None:
    job, other = submitted(client, people["ann"]), bearer(keys.rotate("ann"))
    assert client.post(f"/v1/jobs/{job}/cancel", headers=other).status_code == 202
    keys.revoke("ann")
    later = bearer(keys.add("ann", Scope.SUBMIT))
    assert client.post(f"/v1/jobs/{job}/retry", headers=later).status_code == 403


def test_keys_of_before_there_were_ids_have_one_through_rotation(keys: KeyFile) -> None:
    old = {"name": "ann", "scope": "submit", "sha256": "a" * 64, "created": "2026-01-01T00:00:00Z"}
    key, again = Key.model_validate(old), Key.model_validate(old | {"sha256": "b" * 64, "created": "2026-02-01"})
    assert key.id and key.id == again.id
    assert key.id != Key.model_validate(old | {"name": "bob"}).id


def test_owners_are_in_the_store_and_survive_a_lost_index(
    client: TestClient, people: dict[str, Headers], services: Services, keys: KeyFile
) -> None:
    ann = next(key.id for key in keys.list() if key.name == "ann")
    job = submitted(client, people["ann"])
    client.post("/v1/datasets", json=MATRIX, headers=people["ann"])
    file = ("ball.stl", b"solid ball\nendsolid ball\n")
    added = client.post("/v1/objects", files={"file": file}, headers=people["ann"])
    assert added.status_code == 202
    fresh = Index("sqlite://")
    rebuild(fresh, services.store)
    found = fresh.jobs.get(job).owner, fresh.datasets.get("d").owner, fresh.assets.get(AssetKind.OBJECT, "ball").owner
    fresh.close()
    assert found == (ann, ann, ann)


@pytest.mark.parametrize(("scope", "passes"), [(Scope.READ, False), (Scope.SUBMIT, False), (Scope.ADMIN, True)])
def test_what_has_no_owner_is_changed_by_an_admin_alone(scope: Scope, passes: bool) -> None:
    token = caller.set(Key(id="1", name="me", scope=scope, sha256="", created=""))
    try:
        if passes:
            must_own("", "hand 'mine'")
        else:
            with pytest.raises(ForeignResource, match=r"hand 'mine'.*'me'.*admin"):
                must_own("", "hand 'mine'")
    finally:
        caller.reset(token)


@WHO
def test_pages_show_a_button_only_to_whom_it_would_serve(
    client: TestClient, people: dict[str, Headers], who: str, may: bool
) -> None:
    job = submitted(client, people["ann"])
    client.post("/v1/datasets", json=MATRIX, headers=people["ann"])
    for page, action in ((f"/jobs/{job}", f"/jobs/{job}/cancel"), ("/datasets/d", "/datasets/d/cancel")):
        assert (f'action="{action}"' in client.get(page, headers=people[who]).text) is may
    page, submits = client.get("/datasets", headers=people[who]).text, who != "eve"
    assert ('action="/datasets"' in page, 'value="cancel"' in page, 'href="/submit"' in page) == (submits,) * 3


def test_chosen_jobs_of_others_are_counted_as_left(client: TestClient, people: dict[str, Headers]) -> None:
    job = submitted(client, people["ann"])
    chosen = {"action": "cancel", "cell": "allegro|mug"}
    answer = client.post("/datasets/cells", data=chosen, headers=people["bob"], follow_redirects=False)
    assert "done=0&left=1" in answer.headers["location"]
    assert client.get(f"/v1/jobs/{job}", headers=people["bob"]).json()["state"] == "queued"


@WHO
def test_objects_networks_and_sets_are_changed_by_their_key(
    client: TestClient, people: dict[str, Headers], who: str, may: bool
) -> None:
    def put(headers: Headers, *objects: str) -> int:
        return client.post("/v1/object-sets", json={"name": "s", "objects": objects}, headers=headers).status_code

    file = {"file": ("net.npz", to_bytes(random_network()))}
    assert client.post("/v1/networks", files=file, headers=people["eve"]).status_code == 403, "a reader adds none"
    client.post("/v1/networks", files=file, headers=people["ann"])
    client.post("/v1/objects", files={"file": ("box.stl", b"solid")}, headers=people["ann"])
    for address in ("/v1/objects/box", "/v1/networks/net"):
        assert client.delete(address, headers=people[who]).status_code == (204 if may else 403)
    built_in = client.delete("/v1/objects/mug", headers=people[who]).status_code
    assert built_in == (403 if who == "eve" else 409), "it comes with graspd"
    assert put(people["ann"], "mug") == put(people["root"], "mug") == 201
    assert put(people[who], "mug", "block") == (201 if may else 403)
    held = client.get("/v1/object-sets/s", headers=people["eve"]).json()["objects"]
    assert ("block" in held) is may
    assert put(people["ann"], "block") == 201
