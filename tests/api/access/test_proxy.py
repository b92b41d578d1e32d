"""People that a proxy has signed in, and those who only say so."""

from __future__ import annotations

import base64
import hmac
import json
from typing import Any

import pytest
from pydantic import SecretStr
from starlette.testclient import TestClient

from graspd.api.access.auth import SESSION_COOKIE, Proxy
from graspd.api.access.keys import KeyFile, Scope
from graspd.api.app import create_app
from graspd.service.model.errors import InputError, UnavailableError
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings

SECRET = "correct horse battery staple"
PROXY, STRANGER = ("10.1.2.3", 4000), ("203.0.113.9", 4000)
GROUPS = {"ops": ":admin", "vision": "red:submit", "hands": "blue:submit", "*": ":read"}
JOB = {"hand": "allegro", "object": "mug", "grasps": 32}


def basic(user: str, secret: str = SECRET) -> str:
    return "Basic " + base64.b64encode(f"{user}:{secret}".encode()).decode()


def headers(user: str = "ann@lab.example", groups: str = "vision", secret: str = SECRET) -> dict[str, str]:
    """What the proxy sends of somebody who is signed in."""
    return {"Authorization": basic(user, secret), "X-Forwarded-Groups": groups}


@pytest.fixture
def behind(settings: Settings) -> Settings:
    said = {"proxy_addresses": "10.1.0.0/16, ::1", "proxy_secret": SecretStr(SECRET), "proxy_groups": GROUPS}
    return settings.model_copy(update=said)


def client(settings: Settings, services: Services, address: tuple[str, int]) -> TestClient:
    return TestClient(create_app(settings, services), base_url="https://graspd.example", client=address)


def test_whom_the_proxy_vouches_for_has_the_rights_of_the_group(behind: Settings) -> None:
    rights = {"vision": ("red", Scope.SUBMIT), "hands": ("blue", Scope.SUBMIT)}
    for groups, (project, scope) in (rights | {"others": ("", Scope.READ), "vision,ops": ("", Scope.ADMIN)}).items():
        key = Proxy(behind).find(_scope(PROXY, headers(groups=groups)))
        assert key is not None and (key.name, key.project, key.scope) == ("ann@lab.example", project, scope)
    closed = behind.model_copy(update={"proxy_groups": {"ops": ":admin"}})
    assert Proxy(closed).find(_scope(PROXY, headers(groups="vision"))) is None


def test_keys_go_on_opening_beside_the_proxy(behind: Settings, services: Services) -> None:
    keys = KeyFile(behind.resolved_keys_file)
    token = keys.add("robot", Scope.SUBMIT, project="red")
    http = client(behind, services, STRANGER)
    assert http.get("/v1/jobs", headers={"Authorization": f"Bearer {token}"}).status_code == 200
    with pytest.raises(InputError, match="users of a proxy"):
        keys.add("ann@lab.example", Scope.ADMIN)


def test_people_of_a_project_find_their_jobs_and_no_others(behind: Settings, services: Services) -> None:
    http = client(behind, services, PROXY)
    job = http.post("/v1/jobs", json=JOB, headers=headers()).json()["id"]
    assert http.get(f"/v1/jobs/{job}", headers=headers("amy@lab.example")).json()["project"] == "red"
    assert http.get(f"/v1/jobs/{job}", headers=headers("bob@lab.example", "hands")).status_code == 404
    assert http.get("/", headers=headers()).status_code == 200
    assert http.post("/v1/jobs", json=JOB, headers=headers("ray@lab.example", "")).status_code == 403


def test_forged_headers_open_nothing(behind: Settings, services: Services) -> None:
    for address, sent in (
        (STRANGER, headers()),
        (("127.0.0.1", 4000), headers()),
        (("testclient", 1), headers()),
        (PROXY, headers(secret="guessed")),
        (PROXY, headers(secret="")),
        (PROXY, {"X-Forwarded-User": "ann", "X-Forwarded-Email": "ann@lab.example", "X-Forwarded-Groups": "ops"}),
        (PROXY, {"Authorization": "Basic !!!", "X-Forwarded-Groups": "ops"}),
        (PROXY, headers(user="")),
        (PROXY, headers(user="a\nb")),
        (STRANGER, headers() | {"X-Forwarded-For": "10.1.2.3", "Forwarded": "for=10.1.2.3"}),
    ):
        http = client(behind, services, address)
        assert http.get("/v1/jobs", headers=sent).status_code == 401, (address, sent)
        assert http.get("/v1/jobs").status_code == 401


def test_a_session_signed_with_the_empty_secret_opens_nothing(behind: Settings, services: Services) -> None:
    assert not behind.resolved_keys_file.exists()
    http = client(behind, services, PROXY)
    for claim in ('["x", 9999999999]', "[]", "3", "{", '{"a": 1}', '["x", "y"]', "null"):
        packed = base64.urlsafe_b64encode(claim.encode()).decode()
        forged = {"Cookie": f"{SESSION_COOKIE}={packed}.{hmac.new(b'', packed.encode(), 'sha256').hexdigest()}"}
        for path in ("/", "/v1/jobs", "/login"):
            answers = [http.get(path, headers=sent, follow_redirects=False) for sent in (forged, {})]
            assert answers[0].status_code == answers[1].status_code < 500


def test_a_key_file_without_a_secret_opens_no_session(settings: Settings) -> None:
    keys = KeyFile(settings.resolved_keys_file)
    keys.add("robot", Scope.ADMIN)
    file = json.loads(settings.resolved_keys_file.read_text())
    settings.resolved_keys_file.write_text(json.dumps(file | {"session_secret": ""}))
    with pytest.raises(UnavailableError, match="session_secret"):
        keys.open_session(keys.list()[0])


def test_headers_that_came_twice_are_not_believed(behind: Settings) -> None:
    twice = [(b"authorization", basic("ann").encode()), (b"x-forwarded-groups", b"ops"), (b"x-forwarded-groups", b"x")]
    assert Proxy(behind).find({"type": "http", "client": PROXY, "headers": twice}) is None
    users = [(b"authorization", basic(who).encode()) for who in ("ann", "bob")]
    assert Proxy(behind).find({"type": "http", "client": PROXY, "headers": users}) is None


@pytest.mark.parametrize(
    "said",
    [
        {"proxy_addresses": "10.0.0.1"},
        {"proxy_secret": SecretStr(SECRET)},
        {"proxy_addresses": "10.0.0.1", "proxy_secret": SecretStr("short")},
        {"proxy_addresses": "proxy.lan", "proxy_secret": SecretStr(SECRET)},
        {"proxy_addresses": "::1", "proxy_secret": SecretStr(SECRET), "proxy_groups": {"a": "b:owner"}},
        {"proxy_addresses": "::1", "proxy_secret": SecretStr(SECRET), "proxy_groups": {"a": "../b:read"}},
    ],
)
def test_a_proxy_that_is_not_told_whole_is_refused(settings: Settings, said: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="GRASPD_PROXY"):
        Proxy(settings.model_copy(update=said))


def _scope(address: tuple[str, int], sent: dict[str, str]) -> dict[str, Any]:
    raw = [(name.lower().encode(), value.encode()) for name, value in sent.items()]
    return {"type": "http", "client": address, "headers": raw}
