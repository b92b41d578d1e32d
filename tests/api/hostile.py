"""What a stranger may send: odd and broken words for methods, paths, headers and bodies of requests."""

from __future__ import annotations

_METHODS = "GET GET GET POST POST HEAD PUT PATCH DELETE OPTIONS TRACE X"

_NAMES = """
    host origin referer cookie authorization range if-range if-none-match if-match if-modified-since accept
    accept-encoding accept-language content-type content-length content-encoding transfer-encoding expect connection
    upgrade forwarded via te x-forwarded-for x-forwarded-host x-forwarded-proto x-forwarded-groups x-forwarded-user
    x-real-ip idempotency-key last-event-id x-request-id traceparent tracestate sec-fetch-site x-http-method-override
    hx-request hx-target user-agent
"""

#: With {job} and {shard}.
_PATHS = """
    / /v1/jobs /v1/jobs/ /v1/jobs/{job} /v1/jobs/{job}/cancel /v1/shards/{shard} /v1/shards/{shard}/file /v1/grasps
    /v1/stats /v1/hands /v1/hands/allegro /v1/hands/allegro/model /v1/hands/allegro/model.glb /v1/objects /v1/datasets
    /v1/datasets/estimate /v1/webhooks /v1/tags /v1/events /v1/usage /v1/object-sets /healthz /readyz /metrics /login
    /logout /submit /jobs /jobs/{job} /datasets /grasps /hands /hands/allegro /workers /usage /events
    /static/style.css /static/app.css /openapi.json /problems/x /nowhere //evil.example/x *
"""

_VALUES = (
    "| |*|null|http://[|http://[::1|//[|[|[::1]:x|http://\xe9|\xff\xfe|http://a:99999/|http://a:b|-1|0x10|1e400|NaN|"
    'bytes=|bytes=-|bytes=9-1|bytes=a-b|bytes=0-0,1-1|W/"|W/*|Thu, 99 Foo 9999 99:99:99 GMT|Bearer|Bearer |Bearer \xa0|'
    'Bearer gd_\xe9|Basic !!!|graspd_session=|graspd_session=\xff; a=b; ;;=|a="\\|=|application/json; charset=nonsense|'
    "100-continue|multipart/form-data|multipart/form-data; boundary=|multipart/form-data; boundary=b|text/html|"
    'text/html;q=\xb2|application/x-www-form-urlencoded|gzip, br|for="[::1";by=|1.2.3.4, , \xe9|127.0.0.1:x|chunked|'
    "h2c|cross-site|%00|\x01|\x7f|../../etc/passwd|../../x|<script>|{}"
)
_LONG = ("a" * 8000, "9" * 5000, '"' * 400, "bytes=0-" + "9" * 400, "bytes=0-0,1-1," + "2-2," * 200, "00-" + "0" * 60)
_LONG_KEYS = ("Bearer " + "a" * 4000, "Basic " + "QQ==" * 500, "graspd_session=W10=." + "0" * 64)

METHODS, NAMES, PATHS = _METHODS.split(), _NAMES.split(), _PATHS.split()
VALUES = [*_VALUES.split("|"), *_LONG, *_LONG_KEYS]
JOB_BODY = b'{"hand": "allegro", "object": "mug", "grasps": 32}'
