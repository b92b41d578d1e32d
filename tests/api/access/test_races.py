"""Requests that come at once, to one API process or to two: what one of them may have, two do not get."""

import time
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Barrier, BrokenBarrierError, Event
from typing import Any
from unittest.mock import Mock

import pytest
from httpx import Response
from pydantic import SecretStr
from redis.exceptions import ConnectionError as RedisAway
from starlette.testclient import TestClient

from graspd.api.access.keys import Key, KeyFile, KeyLimits, Scope
from graspd.api.access.quotas import Quotas
from graspd.service.index.rebuild import differences
from graspd.service.model.errors import InputError, QuotaError
from graspd.service.model.records import JobRecord, ObjectSet, create_object_set
from graspd.service.model.webhooks import MOST_HOOKS
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets.actions import DatasetController
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.settings import Settings
from graspd.service.store import library
from graspd.service.store.records import read_record
from graspd.service.store.store import Store
from tests.api.factories import bearer, finish_all, people_of
from tests.fakes import record_of

#: Often enough for two requests to meet.
ROUNDS = 10
SETS = "/v1/object-sets"
MATRIX = {"hands": ["allegro"], "objects": ["mug"], "grasps": 5}
JOB = {"hand": "allegro", "object": "mug", "grasps": 5}
KEY = Key(id="1", name="me", scope=Scope.SUBMIT, sha256="", created="", limits=KeyLimits(grasps_in_flight=20))
MakeQuotas = Callable[[Callable[[Collection[str]], Collection[str]]], Quotas]


@pytest.fixture
def twins(make_twins: Callable[..., list[TestClient]], keys: KeyFile) -> list[TestClient]:
    """Clients of two applications with one key."""
    made = make_twins(webhook_secret=SecretStr("s" * 16))
    headers = bearer(keys.add("me", Scope.SUBMIT, limits=KEY.limits))
    for client in made:
        client.headers.update(headers)
    return made


@pytest.fixture
def quotas(settings: Settings, rq_queue: RqQueue, noon: None) -> MakeQuotas:
    return lambda unfinished: Quotas(settings, rq_queue.connection, unfinished)


def held(rq_queue: RqQueue) -> int:
    return sum(map(int, rq_queue.connection.hvals("graspd:quota:me:jobs")))


def today(rq_queue: RqQueue) -> int:
    return sum(int(rq_queue.connection.get(day)) for day in rq_queue.connection.scan_iter("graspd:quota:me:2*"))


def test_thirty_jobs_at_once_over_two_apis_stay_within_the_quota(twins: list[TestClient]) -> None:
    def submit(seed: int) -> int:
        return twins[seed % 2].post("/v1/jobs", json=JOB | {"seed": seed}).status_code

    with ThreadPoolExecutor(30) as pool:
        answers = sorted(pool.map(submit, range(30)))
    assert answers == [202] * 4 + [429] * 26


def test_a_job_that_is_being_entered_stays_counted(quotas: MakeQuotas, rq_queue: RqQueue) -> None:
    """A second submission waits for the first one, and then finds its job in the index."""
    entered: set[str] = set()
    is_inside = Event()

    def first() -> None:
        with quotas(lambda ids: entered).claim(KEY, "a", 20):
            is_inside.set()
            time.sleep(0.2)
            entered.add("a")

    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(first)
        assert is_inside.wait(60)
        with pytest.raises(QuotaError), quotas(lambda ids: entered).claim(KEY, "b", 5):
            pass
        done.result()
    assert held(rq_queue) == 20


@pytest.mark.parametrize("made", [(True, False), (False, True), (False, False)])
def test_of_two_claims_the_one_that_made_a_job_counts(quotas: MakeQuotas, rq_queue: RqQueue, made: list[bool]) -> None:
    one = quotas(set)
    for counts in made:
        with one.claim(KEY, "a", 20) as claim:
            claim.counts = counts
    with suppress(InputError), one.claim(KEY, "a", 20):
        raise InputError("a claim of a known job that fails changes nothing")
    assert (held(rq_queue), today(rq_queue)) == ((20, 1) if any(made) else (0, 0))


def test_a_retry_of_fewer_grasps_leaves_the_sum_true(quotas: MakeQuotas, rq_queue: RqQueue) -> None:
    ended: set[str] = set()
    one = quotas(lambda ids: set(ids) - ended)
    with one.claim(KEY, "a", 20):
        pass
    with one.claim(KEY, "a", 5, is_new=False):
        pass
    assert held(rq_queue) == 20
    ended.add("a")
    with one.claim(KEY, "b", 5):
        pass
    assert (held(rq_queue), today(rq_queue)) == (5, 2)


def test_a_claim_of_a_dead_process_ends(quotas: MakeQuotas, rq_queue: RqQueue, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.api.access.quotas._LOCKED_S", 0.2)
    one = quotas(lambda ids: set())
    died = one.claim(KEY, "a", 20)
    died.__enter__()
    monkeypatch.setattr("graspd.api.access.quotas._PATIENCE_S", 0.05)
    with pytest.raises(QuotaError, match="at once"), one.claim(KEY, "b", 5):
        pass
    time.sleep(0.2)
    with one.claim(KEY, "b", 5):
        pass
    assert held(rq_queue) == 5


@pytest.mark.parametrize("step", ["lock", "hexists", "hgetall", "pipeline", "hdel"])
def test_redis_that_goes_at_any_step_refuses_no_job(
    quotas: MakeQuotas, rq_queue: RqQueue, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    one = quotas(lambda ids: set())
    rq_queue.connection.hset("graspd:quota:me:jobs", "ended", 20)
    with monkeypatch.context() as patch:
        patch.setattr(rq_queue.connection, step, Mock(side_effect=RedisAway("gone")))
        with one.claim(KEY, "a", 5) as claim:
            claim.counts = False
    with one.claim(KEY, "b", 20):
        pass
    assert (held(rq_queue), today(rq_queue)) == (20, 1)


@pytest.mark.parametrize("refused", [{"object": "unheard-of"}, {"grasps": 21}])
def test_a_refusal_frees_the_idempotency_key(twins: list[TestClient], keys: KeyFile, refused: dict[str, Any]) -> None:
    keyed = {"Idempotency-Key": "one"}
    assert twins[0].post("/v1/jobs", json=JOB | refused, headers=keyed).status_code in (404, 429)
    assert twins[1].post("/v1/jobs", json=JOB, headers=keyed).status_code == 202
    assert twins[0].post("/v1/jobs", json=JOB | {"seed": 9}, headers=keyed).status_code == 422
    yours = keyed | bearer(keys.add("you", Scope.SUBMIT))
    assert twins[0].post("/v1/jobs", json=JOB | {"seed": 9}, headers=yours).status_code == 202


def test_of_two_objects_of_one_name_at_once_one_gets_it(
    twins: list[TestClient], services: Services, monkeypatch: pytest.MonkeyPatch
) -> None:
    together = Barrier(2)
    put_file = Store.put_file

    def both_have_looked(self: Store, key: str, file: Any) -> bool:
        if key.startswith("assets/object/") and key.endswith("files.zip"):
            with suppress(BrokenBarrierError):
                together.wait(60)
        return put_file(self, key, file)

    def upload(number: int) -> int:
        file = {"file": (f"ball{number}.stl", f"solid {number}\nendsolid {number}\n".encode())}
        return twins[number].post("/v1/objects", files=file, data={"name": "ball"}).status_code

    monkeypatch.setattr(Store, "put_file", both_have_looked)
    with ThreadPoolExecutor(2) as pool:
        assert sorted(pool.map(upload, range(2))) == [202, 409]
    stored = [library.load_asset(services.store, *found).name for found in library.stored_assets(services.store)]
    assert stored.count("ball") == 1


def at_once(twins: list[TestClient], ask: Callable[[TestClient, int], Response]) -> list[Response]:
    start = Barrier(2)

    def asked(number: int) -> Response:
        start.wait(60)
        return ask(twins[number], number)

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(asked, range(2)))


def codes(answers: list[Response]) -> list[int]:
    return sorted(answer.status_code for answer in answers)


def strayed(services: Services) -> list[str]:
    """Rows that are not what the store says, but for those of the assets, which came without a check."""
    return [line for line in differences(services.index, services.store) if not line.startswith("assets ")]


@pytest.fixture
def projects(settings: Settings) -> list[dict[str, str]]:
    """Headers of a key of each of two projects."""
    return list(people_of(settings, red=(Scope.SUBMIT, "red"), blue=(Scope.SUBMIT, "blue")).values())


def test_of_two_projects_that_want_one_set_name_one_gets_it(
    twins: list[TestClient], projects: list[dict[str, str]], services: Services
) -> None:
    for number in range(ROUNDS):
        body = {"name": f"set{number}", "objects": ["mug"]}
        answers = at_once(twins, lambda http, n, body=body: http.post(SETS, json=body, headers=projects[n]))
        assert codes(answers) == [201, 409]
    assert strayed(services) == []


def test_of_two_versions_of_a_set_at_once_one_follows_the_other(twins: list[TestClient], services: Services) -> None:
    for number in range(ROUNDS):
        name = f"set{number}"
        bodies = [{"name": name, "objects": objects} for objects in (["mug"], ["block"])]
        assert codes(at_once(twins, lambda http, n, bodies=bodies: http.post(SETS, json=bodies[n]))) == [201, 201]
        kept = [read_record(ObjectSet, services.store, one.key) for one in services.store.list(f"object_sets/{name}")]
        first = next(one for one in kept if one.digest == create_object_set(name, one.objects).digest)
        later = next(one for one in kept if one is not first)
        assert later.digest == create_object_set(name, later.objects, after=first.digest).digest


def test_of_two_datasets_of_one_name_at_once_one_gets_it(twins: list[TestClient], services: Services) -> None:
    def create(http: TestClient, number: int) -> Response:
        return http.post("/v1/datasets", json=MATRIX | {"name": "all", "seed": number})

    assert codes(at_once(twins, create)) == [202, 409]
    assert strayed(services) == []


def test_of_two_last_webhooks_at_once_one_is_made(twins: list[TestClient], projects: list[dict[str, str]]) -> None:
    def add(http: TestClient, _: int = 0) -> Response:
        return http.post("/v1/webhooks", json={"url": "https://example.org/"}, headers=projects[0])

    made = [add(twins[0]) for _ in range(MOST_HOOKS - 1)]
    for _ in range(ROUNDS):
        answers = at_once(twins, add)
        assert codes(answers) == [201, 413]
        made = [answer for answer in answers if answer.status_code == 201]
        twins[0].delete(f"/v1/webhooks/{made[0].json()['id']}", headers=projects[0])


@pytest.mark.parametrize("what", ["job", "dataset"])
def test_of_two_cancellations_at_once_one_counts(twins: list[TestClient], services: Services, what: str) -> None:
    """Each leaves an event in the store: of two with one number a rebuild would not know which came last."""
    for number in range(4):
        body = JOB | {"grasps": 1, "seed": number} if what == "job" else MATRIX | {"name": f"all{number}", "grasps": 1}
        made = twins[0].post(f"/v1/{what}s", json=body).json()
        name = made["id"] if what == "job" else made["name"]
        for count, action in enumerate(("cancel", "retry"), start=1):
            path = f"/v1/{what}s/{name}/{action}"
            assert codes(at_once(twins, lambda http, _, path=path: http.post(path))) == [202, 409]
            assert len(list(services.store.list(f"{what}s/{name}/events"))) == count


def test_two_snapshots_at_once_are_one(twins: list[TestClient], services: Services) -> None:
    twins[0].post("/v1/datasets", json=MATRIX | {"name": "all"})
    DatasetController(services).advance()
    job = next(services.store.list("jobs")).key
    finish_all(services, read_record(JobRecord, services.store, job))
    answers = at_once(twins, lambda http, _: http.post("/v1/datasets/all/snapshots"))
    assert codes(answers) == [200, 201]
    assert answers[0].json() == answers[1].json()


def test_a_tag_given_twice_at_once_has_the_grasps_of_both(twins: list[TestClient], services: Services) -> None:
    job = twins[0].post("/v1/jobs", json=JOB).json()["id"]
    shard = finish_all(services, record_of(services, job))[0].shard_id

    def give(http: TestClient, number: int) -> Response:
        return http.post("/v1/tags", json={"name": "good", "grasps": [{"shard_id": shard, "row": number}]})

    assert codes(at_once(twins, give)) == [200, 200]
    assert [tag["grasps"] for tag in twins[0].get("/v1/tags").json()] == [2]
    assert strayed(services) == []
