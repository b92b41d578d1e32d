"""Headers of odd bytes: no answer is a 5xx."""

from __future__ import annotations

from itertools import cycle, product

from starlette.testclient import TestClient

from graspd.service.pipeline.backends import Services
from tests.api.factories import add_job, finish_all

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
BODIES = (b"", b"[", b"\xff" * 50, b'{"hand": "\\ud800"}', b"a=b&" * 2000, b"--b\r\nContent-Disposition: x\r\n\r\n")


def test_no_value_of_a_header_ends_in_a_5xx(http: TestClient, services: Services) -> None:
    record = add_job(services)
    shard = finish_all(services, record)[0].shard_id
    methods = cycle(("GET", "POST", "POST"))
    paths, bodies, found = cycle(PATHS.format(record.id, shard).split()), cycle(BODIES), set[int]()
    for name, value in product(NAMES.split(), [*_VALUES.split("|"), *_LONG]):
        path, method = next(paths), next(methods)
        headers = {name.encode(): value.encode("latin-1")}
        answer = http.request(method, path, content=next(bodies) if method == "POST" else None, headers=headers)
        assert answer.status_code < 500, (method, path, name, value)
        found.add(answer.status_code)
    assert {200, 400, 403, 404, 405, 421, 422} <= found, "the requests reach what they are to reach"
