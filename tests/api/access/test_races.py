"""Requests that come at once, to one API process or to two: what one of them may have, two do not get."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Barrier, BrokenBarrierError
from typing import Any

import pytest
from pydantic import SecretStr
from starlette.testclient import TestClient

from api.access.keys import Key, KeyFile, KeyLimits, Scope
from api.access.quotas import Quotas
from api.app import create_app
from service.model import names
from service.model.errors import QuotaError
from service.model.records import JobRecord
from service.pipeline.backends import Parts
from service.queue.rq_queue import RqQueue
from service.settings import Settings
from service.store import library
from service.store.records import read_record
from service.store.store import Store
from tests.api.factories import finish_all

JOB = {"hand": "allegro", "object": "mug", "grasps": 5}
KEY = Key(id="1", name="me", scope=Scope.SUBMIT, sha256="", created="", limits=KeyLimits(grasps_in_flight=20))
Unfinished = Callable[[Collection[str]], Collection[str]]


@pytest.fixture
def twins(
    settings: Settings, parts: Parts, redis_server: str, rq_queue: RqQueue, noon: None
) -> Iterator[list[TestClient]]:
    """Two applications over the same parts, keys and Redis."""
    wanted = settings.model_copy(update={"redis_url": SecretStr(redis_server)})
    shared = Parts(wanted, parts.store, parts.index, parts.queue)
    clients = [TestClient(create_app(wanted, shared), base_url="http://127.0.0.1:8000") for _ in range(2)]
    for client in clients:
        client.__enter__()
    yield clients
    for client in clients:
        client.__exit__(None, None, None)


@pytest.fixture
def headers(settings: Settings) -> dict[str, str]:
    keys = KeyFile(settings.resolved_keys_file)
    return {"Authorization": f"Bearer {keys.add('me', Scope.SUBMIT, limits=KEY.limits)}"}


@pytest.fixture
def quotas(settings: Settings, rq_queue: RqQueue, noon: None) -> Callable[[Unfinished], Quotas]:
    return lambda unfinished: Quotas(settings, rq_queue.connection, unfinished)


def held(rq_queue: RqQueue) -> int:
    return int(rq_queue.connection.hget("graspd:quota:me:held", "grasps") or 0)


def test_thirty_jobs_at_once_over_two_apis_stay_within_the_quota(
    twins: list[TestClient], headers: dict[str, str]
) -> None:
    def submit(seed: int) -> int:
        return twins[seed % 2].post("/v1/jobs", json=JOB | {"seed": seed}, headers=headers).status_code

    with ThreadPoolExecutor(30) as pool:
        answers = sorted(pool.map(submit, range(30)))
    assert answers == [202] * 4 + [429] * 26


def test_a_job_that_is_being_entered_is_not_taken_for_one_that_ended(
    quotas: Callable[[Unfinished], Quotas], rq_queue: RqQueue
) -> None:
    nothing_known = quotas(lambda ids: set())
    with nothing_known.claim(KEY, "a", 20), pytest.raises(QuotaError), nothing_known.claim(KEY, "b", 5):
        pass
    assert held(rq_queue) == 20


def test_a_job_that_is_retried_while_somebody_looks_stays_counted(
    quotas: Callable[[Unfinished], Quotas], rq_queue: RqQueue
) -> None:
    one = quotas(lambda ids: set())
    with one.claim(KEY, "a", 20):
        pass

    def retried_meanwhile(ids: Collection[str]) -> set[str]:
        with one.claim(KEY, "a", 20, is_new=False):
            pass
        return set()

    with pytest.raises(QuotaError), quotas(retried_meanwhile).claim(KEY, "b", 5):
        pass
    assert held(rq_queue) == 20


@pytest.mark.parametrize("first_made_it", [True, False])
def test_of_two_claims_of_one_job_the_one_that_made_it_counts(
    quotas: Callable[[Unfinished], Quotas], rq_queue: RqQueue, first_made_it: bool
) -> None:
    one = quotas(set)
    with one.claim(KEY, "a", 20) as first:
        with one.claim(KEY, "a", 20) as second:
            second.counts = not first_made_it
        first.counts = first_made_it
    assert held(rq_queue) == 20
    today = next(iter(rq_queue.connection.scan_iter("graspd:quota:me:2*")))
    assert int(rq_queue.connection.get(today)) == 1


def test_claims_of_a_job_that_was_there_already_cost_nothing(
    quotas: Callable[[Unfinished], Quotas], rq_queue: RqQueue
) -> None:
    one = quotas(set)
    with one.claim(KEY, "a", 20) as first:
        with one.claim(KEY, "a", 20) as second:
            second.counts = False
        first.counts = False
    assert held(rq_queue) == 0


def test_a_retry_of_fewer_grasps_leaves_the_sum_true(quotas: Callable[[Unfinished], Quotas], rq_queue: RqQueue) -> None:
    ended: set[str] = set()
    one = quotas(lambda ids: set(ids) - ended)
    with one.claim(KEY, "a", 20):
        pass
    with one.claim(KEY, "a", 5, is_new=False):
        pass
    ended.add("a")
    with one.claim(KEY, "b", 5):
        pass
    assert held(rq_queue) == 5


def test_a_claim_of_a_process_that_died_ends(
    quotas: Callable[[Unfinished], Quotas], rq_queue: RqQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("api.access.quotas._PENDING_S", 0)
    one = quotas(lambda ids: set())
    died = one.claim(KEY, "a", 20)
    died.__enter__()
    with one.claim(KEY, "b", 5):
        pass
    assert held(rq_queue) == 5


def test_jobs_that_ended_make_room(
    twins: list[TestClient], headers: dict[str, str], parts: Parts, rq_queue: RqQueue
) -> None:
    first = twins[0].post("/v1/jobs", json=JOB | {"grasps": 20}, headers=headers).json()["id"]
    assert twins[1].post("/v1/jobs", json=JOB, headers=headers).status_code == 429
    finish_all(parts, read_record(JobRecord, parts.store, names.job_record(first)))
    assert twins[1].post("/v1/jobs", json=JOB, headers=headers).status_code == 202


@pytest.mark.parametrize("refused", [{"object": "unheard-of"}, {"grasps": 21}])
def test_a_refused_request_leaves_its_idempotency_key_free(
    twins: list[TestClient], headers: dict[str, str], refused: dict[str, Any]
) -> None:
    keyed = headers | {"Idempotency-Key": "one"}
    assert twins[0].post("/v1/jobs", json=JOB | refused, headers=keyed).status_code in (404, 429)
    assert twins[1].post("/v1/jobs", json=JOB, headers=keyed).status_code == 202
    assert twins[0].post("/v1/jobs", json=JOB | {"seed": 9}, headers=keyed).status_code == 422


def test_of_two_objects_of_one_name_at_once_one_gets_it(
    twins: list[TestClient], headers: dict[str, str], parts: Parts, monkeypatch: pytest.MonkeyPatch
) -> None:
    together = Barrier(2)
    put_file = Store.put_file

    def both_have_looked(self: Store, key: str, file: Any) -> bool:
        if key.startswith("assets/object/") and key.endswith("files.zip"):
            with suppress(BrokenBarrierError):
                together.wait(60)
        return put_file(self, key, file)

    def upload(number: int) -> int:
        ball = (f"ball{number}.stl", f"solid {number}\nendsolid {number}\n".encode())
        return (
            twins[number].post("/v1/objects", files={"file": ball}, data={"name": "ball"}, headers=headers).status_code
        )

    monkeypatch.setattr(Store, "put_file", both_have_looked)
    with ThreadPoolExecutor(2) as pool:
        assert sorted(pool.map(upload, range(2))) == [202, 409]
    stored = [library.load_asset(parts.store, *found).name for found in library.stored_assets(parts.store)]
    assert stored.count("ball") == 1
