"""The service below a path of a proxy: every address that leaves has it, whether the proxy takes it off or not."""

import re
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from pydantic import ValidationError
from starlette.testclient import TestClient

from graspd.api.access.keys import KeyFile, Scope
from graspd.api.app import create_app
from graspd.api.middleware.request_context import RootPath, add_prefix
from graspd.client.client import Client
from graspd.service.model.errors import InputError
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from tests.api.conftest import BASE_URL
from tests.api.factories import add_job, finish_all

PREFIX = "/graspd"
_FORM = re.compile(r"/(retry|delete|cancel|tag|untag|cells|snapshot)$")


@pytest.fixture
def below(settings: Settings) -> Settings:
    return settings.model_copy(update={"api_root_path": PREFIX})


@pytest.fixture(params=[PREFIX, ""], ids=["kept", "stripped"])
def http(request: pytest.FixtureRequest, below: Settings, services: Services) -> Iterator[TestClient]:
    """A client behind a proxy that passes the prefix on, and one behind a proxy that takes it off."""
    app = create_app(below, services)

    async def proxy(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "http":
            assert scope["path"].startswith(PREFIX), f"{scope['path']} is not the service's"
            path = request.param + scope["path"].removeprefix(PREFIX)
            scope = {**scope, "path": path, "raw_path": path.encode()}
        await app(scope, receive, send)

    with TestClient(proxy, base_url=BASE_URL, raise_server_exceptions=False) as client:
        yield client


def addresses(page: str) -> set[str]:
    return set(re.findall(r'\s(?:href|src|action|formaction|hx-get|data-[a-z]+)="(/[^"#]*)', page))


def test_every_address_of_a_page_is_below_the_prefix_and_there(http: TestClient, services: Services) -> None:
    job = add_job(services, scenes=1, views=1)
    finish_all(services, job)
    seen: set[str] = set()
    left = {f"{PREFIX}/", f"{PREFIX}/jobs/{job.id}", f"{PREFIX}/login", f"{PREFIX}/none"}
    while left and len(seen) < 80:
        path = left.pop()
        seen.add(path)
        answer = http.get(path.replace("&amp;", "&")) if "/events" not in path else None
        if answer is not None and "text/html" in answer.headers["content-type"]:
            found = addresses(answer.text)
            assert not [one for one in found if not one.startswith(f"{PREFIX}/")], path
            left |= {one for one in found if not _FORM.search(one)} - seen
    assert len(seen) > 40


def test_redirects_and_cookies_are_below_the_prefix(http: TestClient, below: Settings) -> None:
    token = KeyFile(below.resolved_keys_file).add("ann", Scope.ADMIN)
    sent_away = http.get(f"{PREFIX}/jobs/x", headers={"Accept": "text/html"}, follow_redirects=False)
    assert sent_away.headers["location"] == f"{PREFIX}/login"
    answer = http.post(f"{PREFIX}/login", data={"key": token}, follow_redirects=False)
    assert answer.headers["location"] == f"{PREFIX}/" and f"Path={PREFIX};" in answer.headers["set-cookie"]
    assert http.get(f"{PREFIX}/").status_code == 200


def test_api_and_client_work_below_a_prefix(http: TestClient, services: Services, tmp_path: Any) -> None:
    finish_all(services, job := add_job(services))
    assert f'Client("{BASE_URL}{PREFIX}")' in http.get(f"{PREFIX}/jobs/{job.id}").text, "a snippet, too"
    assert http.get(f"{PREFIX}/openapi.json").json()["servers"] == [{"url": PREFIX}]
    made = http.post(f"{PREFIX}/v1/jobs", json={"hand": "allegro", "object": "mug", "grasps": 32})
    assert http.get(made.headers["location"]).json()["id"] == made.json()["id"]
    problem = http.get(f"{PREFIX}/v1/jobs/none").json()
    assert http.get(problem["type"]).status_code == 200

    def forward(request: httpx.Request) -> httpx.Response:
        answer = http.request(request.method, str(request.url))
        return httpx.Response(answer.status_code, content=answer.content)

    with Client(f"{BASE_URL}{PREFIX}/", transport=httpx.MockTransport(forward)) as client:
        (shard,) = client.job(job.id).shards
        assert client.save(shard.file, tmp_path / "x.h5").stat().st_size > 0


def test_addresses_of_this_host_alone_get_the_prefix() -> None:
    links = '<a href="//cdn/x"><a href="https://x/"><a href="#x"><a href="?x">'
    same = f'<p title="/x">="/x"</p>{links}<input value="/jobs">'
    assert add_prefix(same, PREFIX) == same
    prefixed = {"/x?a=/b#c": "/graspd/x?a=/b#c", "http://me/x": "http://me/graspd/x"}
    for where, expected in (prefixed | {other: other for other in ("http://you/x", "x", "?x")}).items():
        assert RootPath(create_app, prefix=PREFIX)._add_prefix(where, "me") == expected  # type: ignore[arg-type]


@pytest.mark.parametrize("said", ["/a b", "/a?b", "/ü", "/../x", "http://x/y", '/"x', "/a//b"])
def test_what_is_no_path_is_refused(said: str) -> None:
    with pytest.raises(ValidationError, match="such as /graspd"):
        Settings(api_root_path=said)
    meant = {"graspd": PREFIX, "/graspd/": PREFIX, "/": None, "a/b": "/a/b"}
    assert [Settings(api_root_path=one).api_root_path for one in meant] == [*meant.values()]


def test_a_path_of_the_service_itself_is_refused(settings: Settings, services: Services) -> None:
    for said in ("/v1", "/jobs", "/static/x", "/metrics"):
        with pytest.raises(InputError, match="GRASPD_API_ROOT_PATH"):
            create_app(settings.model_copy(update={"api_root_path": said}), services)
