"""The client turns problem documents back into the exceptions they came from, and outlives a restart of the API."""

import re
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import httpx
import pytest

from graspd.api.models import Job
from graspd.client import client as client_module
from graspd.client.client import Client
from graspd.service.model import errors
from graspd.service.model.states import AssetKind, State
from tests.worker.commands_run import refused

Handler = Callable[[httpx.Request], httpx.Response]
ASSET = dict.fromkeys(("name", "digest", "filename", "created"), "") | {"kind": "hand", "files": [], "size_bytes": 1}
ASSET |= {"builtin": False, "verdict": None, "message": None, "repairs": [], "facts": {}}


def client_of(handler: Handler) -> Client:
    return Client("http://127.0.0.1:8000", key="gd_secret", transport=httpx.MockTransport(handler))


def job(state: State) -> Job:
    asked = {"hand": "allegro", "object": "mug", "method": "fast_graspd", "fidelity": "standard", "requested": 32}
    found = {"grasps": 0, "valid": 0, "progress": 0.0, "created": "2026-01-01T00:00:00Z", "stages": []}
    return Job(id="a" * 32, state=state, **asked, **found)


def event(name: str, state: State) -> bytes:
    return f"event: {name}\ndata: {job(state).model_dump_json()}\n\n".encode()


@pytest.mark.parametrize(
    ("slug", "status", "kind"),
    [
        ("not-found", 404, errors.NotFoundError),
        ("conflict", 409, errors.ConflictError),
        ("queue-unavailable", 503, errors.QueueUnavailable),
        ("invalid-input", 422, errors.InputError),
        ("unauthorized", 401, errors.InputError),
        ("internal", 500, errors.GraspdError),
        ("something-newer", 503, errors.UnavailableError),
    ],
)
def test_a_problem_document_becomes_its_exception(slug: str, status: int, kind: type[errors.GraspdError]) -> None:
    answer = httpx.Response(status, json={"type": f"/problems/{slug}", "detail": "what is wrong"})
    with client_of(lambda _: answer) as client, pytest.raises(kind, match="what is wrong") as caught:
        client.job("a")
    assert type(caught.value) is kind
    with pytest.raises(errors.InputError, match="404"):
        client_of(lambda _: httpx.Response(404, text="<html>nginx")).job("a")


def test_lists_are_read_to_their_last_page_with_the_key() -> None:
    def handler(request: httpx.Request) -> httpx.Response:
        assert request.headers["authorization"] == "Bearer gd_secret"
        cursor = request.url.params.get("cursor")
        asset = ASSET | {"name": {None: "one", "2": "two"}[cursor]}
        return httpx.Response(200, json={"items": [asset], "next": "2" if cursor is None else None})

    with client_of(handler) as client:
        assert [asset.name for asset in client.assets(AssetKind.HAND)] == ["one", "two"]


def test_watching_goes_on_where_the_stream_broke() -> None:
    streams = iter([event("progress", State.RUNNING), event("end", State.SUCCEEDED)])

    def handler(request: httpx.Request) -> httpx.Response:
        return httpx.Response(200, headers={"content-type": "text/event-stream"}, content=next(streams))

    with client_of(handler) as client:
        assert [seen.state for seen in client.watch("a")] == [State.RUNNING, State.SUCCEEDED]


def test_watching_a_service_that_stays_away_ends_with_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "time", Mock(**{"monotonic.side_effect": (0.0, 1.0, 31.0)}))
    away = Mock(side_effect=(httpx.ConnectError("gone"),) * 2)
    with client_of(away) as client, pytest.raises(errors.UnavailableError, match="no graspd answers"):
        next(client.watch("a"))


def test_a_check_that_no_worker_makes_is_waited_for_so_long() -> None:
    answers = iter((ASSET, ASSET | {"verdict": "accept"}))
    client = client_of(lambda _: httpx.Response(200, json=next(answers)))
    with pytest.raises(errors.UnavailableError, match="is a worker running"):
        client.wait_for_check(AssetKind.HAND, "a", timeout_s=-1.0)


def test_no_job_is_made_of_a_refused_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refusal = httpx.Response(200, json=ASSET | {"verdict": "refuse", "message": "the mesh is open"})
    monkeypatch.setattr("graspd.client.reports.open_client", lambda _: client_of(lambda _: refusal))
    (tmp_path / "open.stl").touch()
    assert "refused: the mesh is open" in refused("submit --hand allegro --object", tmp_path / "open.stl")


def test_a_download_that_breaks_leaves_no_file(tmp_path: Path) -> None:
    client = client_of(Mock(side_effect=httpx.ReadError("connection lost")))
    with pytest.raises(errors.UnavailableError, match="connection lost"):
        client.save("/v1/shards/a/file", tmp_path / "a.h5")
    assert list(tmp_path.iterdir()) == []


def test_requests_that_come_too_fast_are_sent_again_but_a_used_up_quota_is_told() -> None:
    fast = httpx.Response(429, json={"type": "/problems/too-many-requests", "detail": ""}, headers={"Retry-After": "0"})
    answers = iter([fast, fast, httpx.Response(200, json={"items": []})])
    assert client_of(lambda _: next(answers)).jobs().items == []
    problem = {"type": "/problems/quota-exceeded", "detail": "no more jobs today"}
    used_up = httpx.Response(429, json=problem, headers={"Retry-After": "3600"})
    with pytest.raises(errors.QuotaError, match="no more jobs today"):
        client_of(lambda _: used_up).jobs()


@pytest.mark.parametrize(
    "url",
    [
        *["http://::1:8000", "http://[::1", "http://127.0\r.0.1:8000", "localhost:8000", "ftp://host", "http://", ""],
        *["http://host:port", "http://me:pass/word@host:8000"],
    ],
)
def test_an_address_that_cannot_be_used_is_one_line_with_the_fix(url: str) -> None:
    with pytest.raises(errors.InputError, match=r"address of the API .* cannot be used; give http://HOST") as refused:
        Client(url)
    assert "pass" not in str(refused.value)


@pytest.mark.parametrize("key", ["gd_abc\u00a0def", "gd_größe", "gd_abc\r\ndef", "gd_abc def", "gd_abc\x00def"])
def test_a_key_with_a_foreign_character_is_refused_and_not_told(key: str) -> None:
    with pytest.raises(errors.InputError, match="GRASPD_API_KEY") as refused:
        Client("http://127.0.0.1:1", key=key)
    assert "gd_" not in str(refused.value)


def test_a_password_in_the_address_is_not_told_and_space_around_it_does_not_matter() -> None:
    assert Client(" http://127.0.0.1:1/\r", key="\u00a0gd_abc\n").url == "http://127.0.0.1:1"
    with Client("http://me:secret@127.0.0.1:1") as client, pytest.raises(errors.UnavailableError) as away:
        client.jobs()
    assert "secret" not in f"{away.value} {client.url}"


def test_names_in_addresses_are_quoted() -> None:
    asked: list[bytes] = []

    def answer(request: httpx.Request) -> httpx.Response:
        asked.append(request.url.raw_path)
        return httpx.Response(404, json={"type": "/problems/not-found", "detail": "there is none"})

    client = client_of(answer)
    for ask in (lambda: client.job("a b"), lambda: client.asset(AssetKind.OBJECT, "a/b?c#d")):
        with pytest.raises(errors.NotFoundError):
            ask()
    assert asked == [b"/v1/jobs/a%20b", b"/v1/objects/a%2Fb%3Fc%23d"]


def test_no_command_pastes_a_name_into_an_address() -> None:
    folder = Path(client_module.__file__).parent
    pasted = re.compile(r'f"/v1/(?!\{kind\.value\}s")')
    assert [file.name for file in folder.glob("*.py") if pasted.search(file.read_text())] == []
