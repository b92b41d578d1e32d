"""Keys, scopes, sessions, foreign web pages, keys as the doctor sees them, and people that a proxy has signed in."""

import base64
import hmac
import json
import stat
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from fastapi import FastAPI
from pydantic import SecretStr
from starlette.testclient import TestClient

from graspd.api.access.auth import SESSION_COOKIE, Proxy
from graspd.api.access.doctor import check_keys as keys_finding
from graspd.api.access.keys import KeyFile, KeyLimits, Scope
from graspd.api.app import create_app
from graspd.client.access_commands import parse_duration
from graspd.service.model.errors import ConflictError, InputError, NotFoundError, QueueUnavailable, UnavailableError
from graspd.service.pipeline.backends import Services
from graspd.service.run.doctor.checks import Condition
from graspd.service.settings import Settings
from tests.api.conftest import BASE_URL
from tests.api.factories import bearer
from tests.memory_queue import MemoryQueue

JOB = {"hand": "allegro", "object": "mug"}
Closed = tuple[TestClient, dict[Scope, str]]
SECRET = "correct horse battery staple"
PROXY, STRANGER = ("10.1.2.3", 4000), ("203.0.113.9", 4000)
GROUPS = {"ops": ":admin", "vision": "red:submit", "hands": "blue:submit", "*": ":read"}


@pytest.fixture
def closed(settings: Settings, services: Services, keys: KeyFile) -> Iterator[Closed]:
    tokens = {scope: keys.add(scope.value, scope) for scope in Scope}
    with TestClient(create_app(settings, services), base_url="https://graspd.example") as client:
        yield client, tokens


def test_a_closed_service_answers_401_without_a_good_key(closed: Closed) -> None:
    client, tokens = closed
    answer = client.get("/v1/jobs")
    assert answer.status_code == 401 and answer.headers["www-authenticate"].startswith("Bearer")
    assert client.get("/v1/jobs", headers=bearer("gd_wrong")).status_code == 401
    assert client.get("/healthz").status_code == 200
    assert client.get("/metrics").status_code == 401
    assert client.get("/metrics", headers=bearer(tokens[Scope.READ])).status_code == 200
    page = client.get("/", headers={"Accept": "text/html"}, follow_redirects=False)
    assert (page.status_code, page.headers["location"]) == (303, "/login")


@pytest.mark.parametrize("scope", Scope)
def test_a_reader_only_reads_and_a_wider_scope_includes_it(closed: Closed, keys: KeyFile, scope: Scope) -> None:
    client, tokens = closed
    headers = bearer(tokens[scope])
    assert client.post("/v1/jobs", json=JOB, headers=headers).status_code == (403 if scope is Scope.READ else 202)
    assert client.get("/v1/jobs", headers=headers).status_code == 200
    keys.revoke(scope.value)
    assert client.get("/v1/jobs", headers=headers).status_code == 401


def test_a_key_opens_a_session_and_its_end_ends_it(closed: Closed, keys: KeyFile) -> None:
    client, tokens = closed
    cookie = client.post("/login", data={"key": tokens[Scope.SUBMIT]}, follow_redirects=False).headers["set-cookie"]
    assert all(word in cookie for word in ("HttpOnly", "SameSite=strict", "Secure"))
    assert tokens[Scope.SUBMIT] not in cookie
    assert client.get("/").status_code == 200
    keys.revoke("submit")
    assert client.get("/v1/jobs").status_code == 401


def test_a_session_ends_where_its_visitor_signs_out(closed: Closed, keys: KeyFile) -> None:
    client, tokens = closed
    claim, _, _ = keys.open_session(keys.list()[2]).partition(".")
    client.cookies.set("graspd_session", f"{claim}.{'0' * 64}")
    assert client.get("/v1/jobs").status_code == 401, "it is forged"
    client.cookies.clear()
    assert "Sign out" not in client.get("/login").text
    client.post("/login", data={"key": tokens[Scope.READ]})
    page = client.get("/login").text
    assert "Sign out" in page and "read" in page
    answer = client.post("/logout", follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/login")
    assert client.get("/v1/jobs").status_code == 401


@pytest.mark.parametrize("cookie", ["", "x", "x.y", ".", "é.é"])
def test_a_session_of_nonsense_is_refused(keys: KeyFile, cookie: str) -> None:
    keys.add("me", Scope.READ)
    assert keys.find_session(cookie) is None


@pytest.mark.parametrize("project", ["Red", "a b", "../x", "x" * 33, "-a"])
def test_a_project_has_a_plain_name(keys: KeyFile, project: str) -> None:
    with pytest.raises(InputError, match="no name of a project"):
        keys.add("ann", Scope.SUBMIT, project=project)


def test_keys_are_kept_hashed_in_a_private_file_by_name(keys: KeyFile) -> None:
    assert keys.add("me", Scope.READ) not in keys.path.read_text()
    assert stat.S_IMODE(keys.path.stat().st_mode) == 0o600
    with pytest.raises(ConflictError):
        keys.add("me", Scope.READ)
    keys.revoke("me")
    found = keys.find(keys.add("me", Scope.SUBMIT))
    assert found is not None and found.scope is Scope.SUBMIT
    with pytest.raises(NotFoundError):
        keys.revoke("nobody")


def test_a_rotated_key_keeps_scope_and_limits_not_its_secret(keys: KeyFile) -> None:
    old = keys.add("me", Scope.SUBMIT, limits=KeyLimits(jobs_per_day=3))
    new = keys.rotate("me")
    found = keys.find(new)
    assert found is not None and (found.scope, found.limits.jobs_per_day) == (Scope.SUBMIT, 3)
    assert keys.find(old) is None
    newer = keys.rotate("me", grace=timedelta(hours=1))
    assert keys.find(new) is not None and keys.find(newer) is not None
    keys.rotate("me", grace=timedelta(microseconds=1))
    assert keys.find(newer) is None, "the grace of a rotation ends"
    keys.revoke("me")
    assert keys.find(new) is None


def test_a_key_opens_until_it_expires(keys: KeyFile) -> None:
    assert keys.find(keys.add("later", Scope.READ, lifetime=timedelta(hours=1))) is not None
    assert keys.find(keys.add("past", Scope.READ, lifetime=timedelta(microseconds=1))) is None


def test_keys_made_at_the_same_time_are_all_kept(keys: KeyFile) -> None:
    with ThreadPoolExecutor(4) as pool:
        tokens = list(pool.map(lambda i: KeyFile(keys.path).add(f"key-{i}", Scope.READ), range(12)))
    assert all(keys.find(token) for token in tokens)


def test_a_damaged_key_file_opens_nothing(closed: Closed, keys: KeyFile) -> None:
    for scope in Scope:
        keys.revoke(scope.value)
    assert closed[0].get("/v1/jobs").status_code == 401, "nor does a service without a live key"
    keys.path.write_text("{")
    answer = closed[0].get("/v1/jobs")
    assert (answer.status_code, answer.json()["type"]) == (503, "/problems/unavailable")


def test_an_open_service_answers_its_own_machine_only(app: FastAPI, http: TestClient) -> None:
    for name in ("X-Forwarded-For", "Forwarded", "Via"):
        answer = http.get("/v1/jobs", headers={name: "203.0.113.9"})
        assert answer.status_code == 403 and "graspd keys add" in answer.json()["detail"]
    assert TestClient(app, base_url=BASE_URL, client=("203.0.113.9", 50000)).get("/v1/jobs").status_code == 403


def test_only_who_may_read_is_told_what_is_wrong_with_a_part(closed: Closed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MemoryQueue, "ping", Mock(side_effect=QueueUnavailable("no answer at redis://inside:6379")))
    client, tokens = closed
    assert "inside" not in client.get("/readyz").text
    assert "inside" in client.get("/readyz", headers=bearer(tokens[Scope.READ])).text


@pytest.mark.parametrize("text", ["", "90", "d", "-1d", "1w", "1.5h"])
def test_a_length_of_time_is_read_or_said_to_be_none(text: str) -> None:
    assert [parse_duration(one).total_seconds() for one in ("90d", "12h", "30m", "45s")] == [7776000, 43200, 1800, 45]
    with pytest.raises(InputError, match="90d"):
        parse_duration(text)


def test_an_address_strangers_reach_needs_a_key(settings: Settings, services: Services, keys: KeyFile) -> None:
    for host in ("0.0.0.0", "::", "192.0.2.7", "graspd.example"):
        exposed = settings.model_copy(update={"host": host})
        with pytest.raises(InputError, match="graspd keys add"):
            create_app(exposed, services)
    keys.add("me", Scope.ADMIN)
    assert create_app(exposed, services)


def test_a_form_on_a_foreign_page_is_refused(http: TestClient) -> None:
    for headers in (
        *({"Sec-Fetch-Site": site} for site in ("cross-site", "same-site")),
        *({"Origin": origin} for origin in ("null", "http://x", "http://[")),
    ):
        assert http.post("/submit", data=JOB, headers=headers).status_code == 403
        assert http.post("/logout", headers=headers).status_code == 403


def test_an_open_service_has_the_names_of_this_machine_alone(http: TestClient) -> None:
    for host, status in (("127.0.0.1:9", 200), ("localhost", 200), ("[::1]:8000", 200), ("evil.example", 421)):
        assert http.get("/healthz", headers={"Host": host}).status_code == status


def test_without_keys_only_this_machine_is_served_and_their_file_is_private(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, host="0.0.0.0")
    assert keys_finding(settings).fix == "graspd keys add admin --scope admin"
    assert keys_finding(Settings(data_dir=tmp_path)).condition is Condition.GOOD
    KeyFile(settings.resolved_keys_file).add("admin", Scope.ADMIN)
    assert keys_finding(settings).condition is Condition.GOOD
    settings.resolved_keys_file.chmod(0o644)
    assert "chmod 600" in keys_finding(settings).fix
    settings.resolved_keys_file.write_text("{")
    found = keys_finding(settings)
    assert not found.ok and str(settings.resolved_keys_file) in found.message


def test_keys_that_end_soon_are_named_unless_they_were_rotated(settings: Settings, keys: KeyFile) -> None:
    keys.add("admin", Scope.ADMIN)
    keys.add("robot", Scope.SUBMIT, lifetime=timedelta(days=2))
    found = keys_finding(settings)
    assert (found.condition, found.fix) == (Condition.WARNING, "graspd keys rotate robot --grace 24h")
    keys.rotate("robot", grace=timedelta(hours=24))
    assert keys_finding(settings).condition is Condition.GOOD
    keys.revoke("admin")
    assert keys_finding(settings).condition is Condition.WARNING, "nobody is admin"
    keys.revoke("robot")
    assert not keys_finding(settings).ok, "no key opens it"


def basic(user: str, secret: str = SECRET) -> str:
    return "Basic " + base64.b64encode(f"{user}:{secret}".encode()).decode()


def headers(user: str = "ann@lab.example", groups: str = "vision", secret: str = SECRET) -> dict[str, str]:
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


def test_a_key_file_without_a_secret_opens_no_session(settings: Settings, keys: KeyFile) -> None:
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
