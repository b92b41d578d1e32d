"""Requests made to break something: each gets an answer that says what is wrong with it."""

import base64
import errno
import json
import os
import tempfile
from itertools import cycle, product
from typing import Any
from unittest.mock import Mock

import pytest
from starlette.testclient import TestClient

from graspd.api.middleware.limits import MAX_BODY_BYTES
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.store.library import load_asset, load_check
from tests.api.factories import add_job, finish_all, zipped

STL = b"solid box\nendsolid box\n"
LISTS: dict[str, tuple[Any, ...]] = {"/v1/grasps": (0.5, "s", 1), "/v1/datasets": ("t", "n")}
LISTS |= dict.fromkeys(("/v1/jobs", "/v1/shards"), ("t", "i")) | dict.fromkeys(("/v1/objects", "/v1/hands"), ("n", "d"))
DEEP = "[" * 800 + "]" * 800


def _cursor(*key: Any) -> str:
    return base64.urlsafe_b64encode(json.dumps(key).encode()).decode().rstrip("=")


def test_a_cursor_of_somebody_s_own_making_is_refused(http: TestClient) -> None:
    bad = {str: "\ud800", int: 2**63, float: 2**63}
    for path, key in LISTS.items():
        # The right shape with a part that no database takes, in each place; and no shape.
        shaped = [_cursor(*key[:i], bad[type(part)], *key[i + 1 :]) for i, part in enumerate(key)]
        for cursor in (*shaped, _cursor(-(2**70)), "rubbish", "eyJ4IjoxfQ", "", "W10"):
            answer = http.get(path, params={"cursor": cursor})
            assert answer.status_code == 422 and "cursor" in answer.json()["detail"], (path, cursor)


def test_a_row_that_no_shard_has_and_a_huge_length_are_no_500(http: TestClient) -> None:
    for row in ("9223372036854775808", "9" * 4000):
        assert http.get(f"/v1/grasps/{'0' * 32}/{row}").status_code in (404, 422)
    assert http.post("/v1/jobs", content=b"{}", headers={"Content-Length": "9" * 4400}).status_code == 413


_BODIES = (b"[" * 100_000, b'{"\\ud800": 1}', b'{"hand": "\\ud800"}', b'{"hand": ' + b"9" * 5000 + b"}", b"\xff")


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/datasets", "/v1/object-sets", "/v1/datasets/estimate"])
def test_a_body_made_to_break_the_reader_is_refused(http: TestClient, path: str) -> None:
    for body in _BODIES:
        answer = http.post(path, content=body, headers={"Content-Type": "application/json"})
        assert answer.status_code in (400, 422), body[:40]
        assert answer.json()["type"] in ("/problems/bad-request", "/problems/invalid-input")


def test_the_answer_to_a_thousand_mistakes_is_short(http: TestClient) -> None:
    answer = http.post("/v1/jobs", json={f"{i:04}" * 60: i for i in range(3000)})
    assert answer.status_code == 422 and len(answer.content) < MAX_BODY_BYTES // 10


_NO_OPTIONS = (
    '5|[1]|null|{|[]|{"\\ud800": 1}|{"facts": "\\udfff"}|{"facts": 5}|{"facts": null}|{"facts": [1]}|{"file": 5}|'
    '{"licence": ["x"]}|{"density": NaN}|{"facts": "x"}'
)
_LONG_OPTIONS = (f'{{"a": {DEEP}}}', "{" * 60_000, f'{{"density": 1{"0" * 400}}}', f'{{"x": "{"ü" * 60_000}"}}')


def test_upload_options_that_are_no_short_object_are_refused(http: TestClient) -> None:
    for options in (*_NO_OPTIONS.split("|"), DEEP, *_LONG_OPTIONS):
        answer = http.post("/v1/objects", files={"file": ("box.stl", STL)}, data={"options": options})
        assert answer.status_code == 422, options[:40]
    assert "leave out what is not needed" in answer.json()["detail"], "nothing but many bytes"


_DESCRIPTIONS = (
    *(b"[" * 100_000, b"5", b"null", b"", b"\xff\xfe"),
    b'{"file": "box.stl", "facts": {"x": ' + DEEP.encode() + b"}}",
    b'{"file": "box.stl", "facts": {"x": "\\ud800"}}',
    b'{"file": "box.stl", "facts": {"x": "' + b"x" * 10_000_000 + b'"}}',  # 10 kB of ZIP, which every list would send
    b" " * 10_000_000 + b'{"file": "box.stl"}',
)


def test_an_asset_json_made_to_break_the_reader_is_refused(http: TestClient) -> None:
    for description in _DESCRIPTIONS:
        packed = zipped({"asset.json": description, "box.stl": STL})
        answer = http.post("/v1/objects", files={"file": ("x.zip", packed)})
        assert answer.status_code == 422 and "asset.json" in answer.json()["detail"], description[:40]


def test_long_findings_of_a_check_do_not_make_the_list_long(http: TestClient, services: Services) -> None:
    http.post("/v1/objects", files={"file": ("box.stl", STL)})
    digest = http.get("/v1/objects/box").json()["digest"]
    found = {"verdict": "repair", "message": "m" * 10**6, "repairs": ["r" * 10**5] * 100}
    found["facts"] = {"faces": 7, "names": ["n" * 1000] * 1000}
    services.store.put(f"assets/object/{digest}/check.json", json.dumps(found).encode())
    kind = AssetKind.OBJECT
    services.index.write.add_asset(load_asset(services.store, kind, digest), load_check(services.store, kind, digest))
    answer = http.get("/v1/objects/box")
    assert len(answer.content) < 300_000 and answer.json()["facts"] == {"faces": 7}


def test_names_of_files_are_bounded(http: TestClient) -> None:
    for files in ({f"{i}" * 60 + "n" * 300: b"" for i in range(3)}, {f"{i:05}" + "n" * 200: b"" for i in range(1500)}):
        answer = http.post("/v1/objects", files={"file": ("x.zip", zipped({**files, "box.stl": STL}))})
        assert answer.status_code in (413, 422)


@pytest.mark.parametrize("where", ["the body", "the archive", "the store"])
def test_a_full_disk_is_told_and_a_retry_works(http: TestClient, where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    full = Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    with monkeypatch.context() as patch:
        if where == "the body":
            patch.setattr(tempfile.SpooledTemporaryFile, "write", full)
        elif where == "the archive":
            patch.setattr("graspd.service.store.library.pack_into", full)
        else:
            patch.setattr("graspd.service.store.store.os.link", full)
        answer = http.post("/v1/objects", files={"file": ("box.stl", STL)})
    assert answer.status_code == 503, answer.text
    assert answer.json()["type"] == "/problems/store-unavailable" and "space" in answer.json()["detail"]
    assert http.post("/v1/objects", files={"file": ("box.stl", STL)}).status_code == 202


#: What the service or its libraries read.
NAMES = """
    host origin cookie authorization range if-range if-none-match accept content-type content-length content-encoding
    transfer-encoding forwarded x-forwarded-for x-forwarded-groups idempotency-key last-event-id x-request-id
    traceparent sec-fetch-site
"""
#: With the id of a job and of a shard.
PATHS = """
    / /v1/jobs /v1/jobs/{0}/cancel /v1/shards/{1}/file /v1/hands/allegro/model /v1/hands /v1/datasets/estimate
    /v1/events /v1/usage /healthz /metrics /login /submit /jobs/{0} /grasps /static/style.css /nowhere
"""
_VALUES = (
    "| |*|null|http://[|http://[::1|//[|[|[::1]:x|http://\xe9|\xff\xfe|http://a:99999/|http://a:b|-1|0x10|1e400|NaN|"
    'bytes=|bytes=-|bytes=9-1|bytes=a-b|bytes=0-0,1-1|W/"|W/*|Thu, 99 Foo 9999 99:99:99 GMT|Bearer|Bearer |Bearer \xa0|'
    'Bearer gd_\xe9|Basic !!!|graspd_session=|graspd_session=\xff; a=b; ;;=|a="\\|=|application/json; charset=nonsense|'
    "multipart/form-data|multipart/form-data; boundary=|multipart/form-data; boundary=b|text/html;q=\xb2|gzip, br|"
    'for="[::1";by=|1.2.3.4, , \xe9|127.0.0.1:x|chunked|cross-site|%00|\x7f|../../x|<script>|{}'
)
_LONG = ("a" * 8000, "9" * 5000, '"' * 400, "bytes=0-" + "9" * 400, "Bearer " + "a" * 4000, "graspd_session=W10=." * 9)
POSTED = (b"", b"[", b"\xff" * 50, b'{"hand": "\\ud800"}', b"a=b&" * 2000, b"--b\r\nContent-Disposition: x\r\n\r\n")


def test_no_value_of_a_header_ends_in_a_5xx(http: TestClient, services: Services) -> None:
    record = add_job(services)
    shard = finish_all(services, record)[0].shard_id
    methods = cycle(("GET", "POST", "POST"))
    paths, bodies, found = cycle(PATHS.format(record.id, shard).split()), cycle(POSTED), set[int]()
    for name, value in product(NAMES.split(), [*_VALUES.split("|"), *_LONG]):
        path, method = next(paths), next(methods)
        headers = {name.encode(): value.encode("latin-1")}
        answer = http.request(method, path, content=next(bodies) if method == "POST" else None, headers=headers)
        assert answer.status_code < 500, (method, path, name, value)
        found.add(answer.status_code)
    assert {200, 400, 403, 404, 405, 421, 422} <= found, "the requests reach what they are to reach"
