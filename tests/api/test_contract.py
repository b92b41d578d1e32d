"""Hypothesis walks the OpenAPI document: no request, however odd, ends in a 500 or an answer that is not declared.

The long walk: `pytest -m slow tests/api/test_contract.py`.
"""

import base64
import json
from collections.abc import Iterator
from typing import Any

import hypothesis
import pytest
import schemathesis
from hypothesis import HealthCheck
from pydantic import SecretStr
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi import checks

from graspd.api.app import create_app
from graspd.service.queue.connection import connect
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.settings import Settings
from tests.api.factories import add_builtins, add_job, add_worker, fail, finish_all
from tests.indexes import open_services

#: Examples of each operation; the many take hours.
_EXAMPLES = (
    pytest.param(6, marks=pytest.mark.timeout(900)),
    pytest.param(1600, marks=[pytest.mark.slow, pytest.mark.timeout(4 * 3600)]),
)
_CHECKS = [not_a_server_error, checks.status_code_conformance, checks.content_type_conformance]
_CHECKS += [checks.response_headers_conformance, checks.response_schema_conformance, checks.unsupported_method]
_PHASES = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
#: Requests that follow the document, and requests that break it.
_MODES = (GenerationMode.POSITIVE, GenerationMode.NEGATIVE)
#: What parameters are made of no type's own accord: put in the place of every third one.
_NASTY_TEXT = ("\u0000", "9" * 4400, str(2**63), "\U0010ffff", "[" * 400, "../../x", "%00", "NaN", "-1", "x" * 400)
_NASTY_KEYS = ([2**63], ["\ud800", "x"], ["x", "\ud800"], [2**70, "x"], [None, None], [0.5, "s", 2**63], "[[[[[[[[")


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory, redis_server: str) -> Iterator[Any]:
    folder = tmp_path_factory.mktemp("contract")
    settings = Settings(data_dir=folder, redis_url=SecretStr(redis_server), max_upload_bytes=1 << 20)
    queue = RqQueue(connect(redis_server))
    queue.connection.flushdb()
    services = open_services(settings, queue=queue)
    add_builtins(services)
    done = add_job(services, scenes=1, views=1)
    finish_all(services, done)
    fail(services, add_job(services, seed=1), "it broke")
    waiting = add_job(services, seed=2)
    add_worker(services)
    services.index.notes.set_complete()
    shard = services.index.shards.page(job=done.id).items[0].id
    known = {"job_id": [done.id, waiting.id], "shard_id": [shard], "name": ["allegro", "mug"]}
    schema = schemathesis.openapi.from_asgi("/openapi.json", _addressed(create_app(settings, services)))

    @schema.hook
    def map_path_parameters(context: Any, path_parameters: dict[str, Any]) -> dict[str, Any]:
        """Every second name is one that exists: else all answers were 404."""
        for name, values in known.items():
            given = (path_parameters or {}).get(name)
            if isinstance(given, str) and len(given) % 2:
                path_parameters[name] = values[len(given) % len(values)]
        return path_parameters

    @schema.hook
    def map_query(context: Any, query: dict[str, Any]) -> dict[str, Any]:
        for name, given in (query or {}).items():
            if (number := len(str(given))) % 3 == 0:
                nasty = _NASTY_TEXT[number % len(_NASTY_TEXT)]
                query[name] = _cursor(_NASTY_KEYS[number % len(_NASTY_KEYS)]) if name == "cursor" else nasty
        return query

    yield schema
    services.close()


def _cursor(key: Any) -> str:
    return base64.urlsafe_b64encode(json.dumps(key).encode()).decode().rstrip("=")


def _addressed(app: Any) -> Any:
    async def call(scope: Any, receive: Any, send: Any) -> None:
        headers = [(name, value) for name, value in scope.get("headers", []) if name != b"host"]
        await app(scope | {"headers": [*headers, (b"host", b"127.0.0.1")]}, receive, send)

    return call


@pytest.mark.parametrize("examples", _EXAMPLES)
def test_every_answer_is_declared_and_none_is_a_500(document: Any, examples: int) -> None:
    mistakes = []
    # A stream of events ends with its job or its client, which is five seconds a request here: other tests read it.
    endless = document.exclude(path_regex="/jobs/[^/]*/events$").exclude(path_regex="/events/stream$")
    for operation in [result.ok() for result in endless.get_all_operations()]:
        try:
            _probe(operation, examples)
        except (Exception, BaseExceptionGroup) as error:
            mistakes.append(f"{operation.label}\n{_shown(error)}")
    assert not mistakes, "\n\n".join(mistakes)


def _probe(operation: Any, examples: int) -> None:
    """Send what Hypothesis makes of one operation's parameters and body, and check what comes back."""

    @hypothesis.settings(max_examples=examples, database=None, phases=_PHASES, suppress_health_check=list(HealthCheck))
    @hypothesis.given(case=hypothesis.strategies.one_of(*(operation.as_strategy(mode) for mode in _MODES)))
    def run(case: Any) -> None:
        case.call_and_validate(checks=_CHECKS)

    run()


def _shown(error: BaseException) -> str:
    inner = getattr(error, "exceptions", None)
    return "\n".join(map(_shown, inner)) if inner else f"{type(error).__name__}: {error}"
