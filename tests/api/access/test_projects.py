"""What a key of one project sees of another's: nothing, by any route. Each route of the application is walked, so one
that is added later and forgets to ask fails here."""

import io
import re
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from fastapi.routing import APIRoute
from pydantic import SecretStr
from starlette.testclient import TestClient

from graspd.api.access.keys import Scope
from graspd.api.app import create_app
from graspd.service.index.index import Index
from graspd.service.index.rebuild import differences, rebuild
from graspd.service.model import names
from graspd.service.model.planning import plan_tasks
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from graspd.service.store.network_file import to_bytes
from tests.api.factories import add_worker, fail, finish_all, people_of
from tests.fakes import plan_all, record_of
from tests.indexes import open_services
from tests.networks import random_network

Headers = dict[str, str]
JOB = {"hand": "allegro", "object": "mug", "grasps": 32, "scenes": 1, "views": 1, "seed": 77}
_BALL = b"solid ball\nendsolid ball\n"


@dataclass
class World:
    client: TestClient
    services: Services
    people: dict[str, Headers]
    said: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        post = partial(self.ask, "ann", "POST")
        job = post("/v1/jobs", json=JOB).json()["id"]
        record = record_of(self.services, job)
        finish_all(self.services, record)
        shard = next(task.output for task in plan_tasks(record))
        views = [task.output for task in plan_tasks(record)][-1]
        failed = post("/v1/jobs", json=JOB | {"seed": 78}).json()["id"]
        fail(self.services, record_of(self.services, failed), "red-secret broke")
        waiting = post("/v1/jobs", json=JOB | {"seed": 79}).json()["id"]
        for kind, name in (("objects", "red-secret-ball"), ("hands", "red-secret-hand")):
            file = ("ball.stl", _BALL) if kind == "objects" else ("hand.urdf", _URDF)
            added = post(f"/v1/{kind}", data={"name": name}, files={"file": file})
            assert added.status_code == 202, added.text
            self.said[f"{kind}_digest"] = added.json()["digest"]
        file = ("gone.stl", _BALL + b" ")
        post("/v1/objects", data={"name": "red-secret-gone"}, files={"file": file})
        assert self.ask("ann", "DELETE", "/v1/objects/red-secret-gone").status_code == 204
        digest = self.ask("ann", "GET", "/v1/hands/allegro").json()["digest"]
        file = ("net.npz", to_bytes(random_network(hand="allegro", digest=digest)))
        added = post("/v1/networks", data={"name": "red-secret-net"}, files={"file": file})
        assert added.status_code == 201, added.text
        self.said["networks_digest"] = added.json()["digest"]
        post("/v1/object-sets", json={"name": "red-secret-set", "objects": ["red-secret-ball", "mug"]})
        matrix = {"name": "red-secret-data", "hands": ["allegro"], "objects": ["mug", "bottle"], "grasps": 32}
        post("/v1/datasets", json=matrix | {"scenes": 1, "views": 1, "seed": 77})
        plan_all(self.services)
        hook = post("/v1/webhooks", json={"url": "https://red-secret.example/"}).json()
        snapshot = post("/v1/datasets/red-secret-data/snapshots").json()["digest"]
        tag = post("/v1/tags", json={"name": "red-secret-tag", "grasps": [{"shard_id": shard, "row": 0}]})
        assert tag.status_code == 200, tag.text
        add_worker(self.services)
        self.said |= {"job_id": job, "failed": failed, "waiting": waiting, "shard_id": shard, "views": views}
        self.said["task_id"] = next(task.id for task in plan_tasks(record))
        self.said |= {"digest": snapshot, "webhook": hook["id"], "webhook_secret": hook["secret"]}

    def ask(self, who: str, method: str, path: str, **content: Any) -> Any:
        return self.client.request(method, path, headers=self.people[who], **content)

    @property
    def secrets(self) -> list[str]:
        named = [f"red-secret-{what}" for what in ("hand", "ball", "gone", "net", "data", "set", "tag")]
        return [*named, "red-secret broke", *self.said.values()]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, furnished: Path) -> Iterator[World]:
    """A service with a job that is done, one that failed, a dataset, a hand, objects and a set of project `red`."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("projects") / "data", webhook_secret=SecretStr("s" * 16))
    shutil.copytree(furnished, settings.data_dir)
    services = open_services(settings)
    of_red = {"ann": (Scope.SUBMIT, "red"), "amy": (Scope.SUBMIT, "red")}
    of_blue = {"bob": (Scope.SUBMIT, "blue"), "eve": (Scope.READ, "blue")}
    people = people_of(settings, **of_red, **of_blue, old=(Scope.SUBMIT, ""), root=(Scope.ADMIN, ""))
    app = create_app(settings, services)
    with TestClient(app, base_url="https://graspd.example", follow_redirects=False) as client:
        yield World(client, services, people)
    services.close()


_URDF = b"""<robot name="two"><link name="base"/><link name="tip"/><joint name="j" type="revolute"><parent link="base"/>
<child link="tip"/><axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""
#: For each parameter of a path: what of the project it may name.
_VALUES: dict[str, tuple[str, ...]] = (
    {"job_id": ("job_id", "failed", "waiting"), "shard_id": ("shard_id", "views"), "kind": ("datasets", "jobs", "tags")}
    | {
        "digest": ("digest", "objects_digest"),
        "row": ("0",),
        "camera": ("scene",),
        "index": ("0",),
        "slug": ("not-found",),
    }
    | {
        "webhook_id": ("webhook",),
        "task_id": ("task_id",),
        "action": ("cancel", "retry", "snapshot", "delete"),
        "what": ("object",),
    }
)
_NAMES = {
    "hands": ("red-secret-hand", "hands_digest"),
    "objects": ("red-secret-ball", "red-secret-gone", "objects_digest"),
    "deleted": ("red-secret-gone",),
    "jobs": ("job_id", "failed"),
    "networks": ("red-secret-net", "networks_digest"),
    "datasets": ("red-secret-data",),
    "object-sets": ("red-secret-set",),
    "tags": ("red-secret-tag",),
}


def _addresses(world: World, template: str) -> Iterator[str]:
    """A route's addresses with everything of the project that could stand in them."""
    parameter = re.search(r"{(\w+)(:\w+)?}", template)
    if parameter is None:
        yield template
        return
    name = parameter[1]
    assert name == "name" or name in _VALUES, f"say in this test what {{{name}}} in {template} may name"
    section = next((part for part in template.split("/") if part in _NAMES), "")
    for value in _NAMES[section] if name == "name" else _VALUES[name]:
        filled = template[: parameter.start()] + world.said.get(value, value) + template[parameter.end() :]
        yield from _addresses(world, filled)


def _bodies(world: World, method: str, address: str) -> list[dict[str, Any]]:
    if method in ("GET", "HEAD", "DELETE"):
        is_list = address.endswith(("/grasps", "/shards", "/export"))
        return [{}, {"params": {"job": world.said["job_id"]}}] if is_list else [{}]
    options = {"grasps": "32", "fidelity": "draft"}
    cells = [world.said["job_id"], world.said["waiting"], "allegro|mug", "allegro|red-secret-ball"]
    pairs = ({"hand": "allegro", "object": "mug"}, {"name": "mine", "hands": ["allegro"], "objects": ["mug"]})
    learned = {"scene": "table", "method": "learned"}
    nets = [{"options": {"network": one}} for one in ("red-secret-net", world.said["networks_digest"])]
    documents = [
        {},
        {"json": {}},
        {"json": {"hand": "red-secret-hand", "object": "red-secret-ball"}},
        {"json": {"hand": "allegro", "object": "mug", "neighbours": ["red-secret-ball"], "scene": "table"}},
        {"json": {"name": "mine", "hands": ["red-secret-hand"], "objects": ["red-secret-ball"]}},
        *({"json": pair | learned | net} for pair in pairs for net in nets),
        {"json": {"hands": ["allegro"], "objects": [], "sets": ["red-secret-set"], "name": "mine"}},
        {"json": {"name": "mine", "objects": ["red-secret-ball"]}},
        {"json": {"name": "mine", "grasps": [{"shard_id": world.said["shard_id"], "row": 0}]}},
        {"json": {"name": "mine", "filter": {"job": world.said["job_id"]}}},
        {"json": {"grasps": [{"shard_id": world.said["shard_id"], "row": 0}]}},
    ]
    forms = [
        {"data": options | {"hand": "red-secret-hand", "object": "red-secret-ball"}},
        {"data": options | {"hand": "allegro", "object_held": world.said["objects_digest"], "held_units": "mm"}},
        {"data": options | {"name": "mine", "hands": "red-secret-hand", "objects": "red-secret-ball"}},
        {"data": {"typed": "red-secret-data"}},
        {"data": {"tag": "mine", "grasp": f"{world.said['shard_id']}:0", "format": "csv"}},
        {"data": {"tag": "red-secret-tag", "all": "true", "filter": f"job={world.said['job_id']}", "format": "csv"}},
        *({"data": options | {"action": action, "cell": cells}} for action in ("submit", "retry", "cancel")),
    ]
    return documents if address.startswith("/v1/") else forms


@pytest.mark.parametrize("who", ["bob", "eve", "old"])
def test_no_route_tells_or_changes_anything_of_another_project(world: World, who: str) -> None:
    before = _state(world)
    routes = [route for route in world.client.app.routes if isinstance(route, APIRoute)]  # type: ignore[attr-defined]
    for method, template in sorted((method, route.path) for route in routes for method in route.methods):
        # One of them tries everything; of the others it is enough to look.
        if template in _ENDLESS or (who != "bob" and method != "GET"):
            continue
        for address in _addresses(world, template):
            for content in _bodies(world, method, address):
                answer = world.ask(who, method, address, **content)
                where = f"{method} {address} {content} -> {answer.status_code}"
                assert answer.status_code < 500 or template == "/readyz", where
                if template != address:
                    # What a path names of another project is not there, whoever asks for it.
                    assert answer.status_code in _NOT_THERE or template in _OF_EVERYBODY, where
                sent = address + str(content)
                secrets = [secret for secret in world.secrets if secret not in sent]
                assert not [secret for secret in secrets if secret in answer.text.replace(sent, "")], where
    assert _state(world) == before


#: Streams that end with their client; what they say is asked for in a test of its own.
_ENDLESS = {"/events", "/v1/jobs/{job_id}/events", "/v1/events/stream"}
_OF_EVERYBODY = {"/problems/{slug}"}
#: A form may be refused before its address is looked up; a reader may submit nothing.
_NOT_THERE = (403, 404, 405, 422)


def _state(world: World) -> Any:
    get = lambda path: world.ask("root", "GET", path).json()  # noqa: E731
    jobs = {job["id"]: job["state"] for job in get("/v1/jobs?limit=200")["items"] if job["project"] == "red"}
    data = get("/v1/datasets/red-secret-data")
    gone = [one["name"] for one in get("/v1/deletions")]
    return gone, jobs, data["cancelled"], data["state"], get("/v1/object-sets/red-secret-set")["objects"]


def test_what_is_out_of_scope_is_refused_as_if_it_were_absent(world: World) -> None:
    gone, waiting, shard = "nothing-of-this-name", world.said["waiting"], world.said["shard_id"]
    hidden = {"jobs": waiting, "datasets": "red-secret-data", "objects": "red-secret-ball", "shards": shard}
    for kind, name in hidden.items():
        answers = {one: world.ask("bob", "GET", f"/v1/{kind}/{one}") for one in (name, gone)}
        assert {answer.status_code for answer in answers.values()} == {404}
        assert len({answer.json()["detail"].replace(one, "X") for one, answer in answers.items()}) == 1
    assert world.ask("bob", "GET", f"/v1/jobs/{waiting}/events").status_code == 404


def test_the_project_itself_and_an_admin_see_all_of_it(world: World) -> None:
    for who in ("ann", "amy", "root"):
        jobs = [job["id"] for job in world.ask(who, "GET", "/v1/jobs?limit=200").json()["items"]]
        assert {world.said["job_id"], world.said["waiting"]} <= set(jobs)
        shard = world.said["shard_id"]
        for path in ("datasets/red-secret-data", "hands/red-secret-hand", f"shards/{shard}/file", f"grasps/{shard}/0"):
            assert world.ask(who, "GET", f"/v1/{path}").status_code == 200
        assert world.ask(who, "GET", f"/v1/grasps?job={world.said['job_id']}").json()["items"]
    job = world.ask("ann", "POST", "/v1/jobs", json=JOB | {"seed": 80}).json()["id"]
    assert world.ask("amy", "POST", f"/v1/jobs/{job}/cancel").status_code == 202
    mine = world.ask("bob", "POST", "/v1/jobs", json=JOB | {"seed": 500}).json()["id"]
    jobs = world.ask("bob", "GET", "/v1/jobs").json()["items"]
    assert mine in [job["id"] for job in jobs] and {job["project"] for job in jobs} == {"blue"}
    assert world.ask("old", "GET", "/v1/grasps").json()["items"] == []


def test_one_request_of_two_projects_is_two_jobs_of_one_shard(world: World) -> None:
    job = world.ask("bob", "POST", "/v1/jobs", json=JOB).json()
    assert job["id"] != world.said["job_id"] and job["state"] == "succeeded"
    assert world.said["shard_id"] in [shard["id"] for shard in job["shards"]]
    assert world.ask("bob", "GET", f"/v1/shards/{world.said['shard_id']}").status_code == 200
    assert world.ask("bob", "DELETE", f"/v1/jobs/{job['id']}").status_code == 204
    assert world.ask("bob", "GET", f"/v1/shards/{world.said['shard_id']}").status_code == 404


def test_the_same_file_of_two_projects_is_two_assets(world: World) -> None:
    digest = world.ask("bob", "GET", "/v1/hands/allegro").json()["digest"]
    net = ("net.npz", to_bytes(random_network(hand="allegro", digest=digest)))
    for kind, name, file in (("objects", "red-secret-ball", ("ball.stl", _BALL)), ("networks", "red-secret-net", net)):
        own = world.ask("bob", "POST", f"/v1/{kind}", data={"name": name}, files={"file": file}).json()
        assert own["digest"] != world.said[f"{kind}_digest"] and own["project"] == "blue"
        assert world.ask("bob", "GET", f"/v1/{kind}/{name}").json()["digest"] == own["digest"]
        assert world.ask("bob", "DELETE", f"/v1/{kind}/{name}").status_code == 204
        assert world.ask("ann", "GET", f"/v1/{kind}/{name}").status_code == 200
    file = {"file": ("private.stl", _BALL.replace(b"ball", b"private"))}
    assert world.ask("old", "POST", "/v1/objects", files=file).status_code == 202
    answer = world.ask("bob", "POST", "/v1/objects", data={"shared": "true"}, files=file)
    assert answer.status_code == 409 and "private to another project" in answer.json()["detail"]


def test_what_is_shared_is_used_by_all_and_deleted_by_its_own(world: World) -> None:
    data = {"name": "common", "shared": "true"}
    file = {"file": ("common.stl", _BALL.replace(b"ball", b"common"))}
    made = world.ask("ann", "POST", "/v1/objects", data=data, files=file).json()
    assert made["shared"] is True
    for who in ("bob", "old"):
        assert world.ask(who, "GET", "/v1/objects/common").json()["digest"] == made["digest"]
    again = world.ask("bob", "POST", "/v1/objects", data={"name": "common"}, files=file).json()
    assert again["digest"] == made["digest"]
    assert world.ask("bob", "DELETE", "/v1/objects/common").status_code == 403
    assert world.ask("amy", "DELETE", "/v1/objects/common").status_code == 204


def test_an_upload_with_the_mark_of_a_project_is_not_its_own(world: World) -> None:
    made = world.services.index.assets.get(AssetKind.OBJECT, world.said["objects_digest"])
    stored = world.services.store.get(names.asset_key(AssetKind.OBJECT, made.digest, "files.zip"))
    with zipfile.ZipFile(io.BytesIO(stored)) as archive:
        assert "graspd-project.txt" in archive.namelist()
    for said in ({}, {"shared": "true"}):
        file = {"file": ("ball.zip", stored)}
        answer = world.ask("old", "POST", "/v1/objects", data={"name": "forged"} | said, files=file)
        assert answer.status_code != 202 or answer.json()["digest"] != made.digest
        assert world.ask("old", "GET", f"/v1/objects/{made.digest}").status_code == 404
        world.ask("old", "DELETE", "/v1/objects/forged")


def test_a_name_of_another_project_is_refused_without_detail(world: World) -> None:
    matrix = {"name": "red-secret-data", "hands": ["allegro"], "objects": ["mug"], "grasps": 32}
    answer = world.ask("bob", "POST", "/v1/datasets", json=matrix)
    assert answer.status_code == 409 and "bottle" not in answer.text and "another dataset" not in answer.text
    objects = {"name": "red-secret-set", "objects": ["mug"]}
    assert world.ask("bob", "POST", "/v1/object-sets", json=objects).status_code == 409


def test_projects_are_in_the_store_and_survive_a_lost_index(world: World) -> None:
    told = differences(world.services.index, world.services.store)
    assert [line for line in told if any(word in line for word in ("project", "shared", "owner"))] == []
    with closing(Index("sqlite://")) as fresh:
        rebuild(fresh, world.services.store)
        hand, data = fresh.assets.get(AssetKind.HAND, "red-secret-hand"), fresh.datasets.get("red-secret-data")
        cell = fresh.jobs.get(fresh.datasets.cells("red-secret-data").items[0].job_id)
        found = (fresh.jobs.get(world.said["job_id"]), data, hand, fresh.object_sets.get("red-secret-set"), cell)
        assert [one.project for one in found] == ["red"] * 5
        owners = {one.owner for one in (*found[:3], cell)}
        assert len(owners) == 1 and "" not in owners
