"""Where a task waits while workers of several versions are there."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import pytest

from graspd.service.model.domain import JobRequest
from graspd.service.model.planning import needed_schema
from graspd.service.model.states import Priority, Stage
from graspd.service.model.workers import FIRST_SCHEMA, Requirements, WorkerBeat, own_ability
from graspd.service.pipeline.job_actions import Route, Routes
from graspd.service.queue import entries
from graspd.service.queue.lists import known_lists, queue_name, queue_names
from graspd.service.queue.rq_queue import RqQueue
from tests.fakes import beat_of, message_for, request

OWN = own_ability()
REVISION = OWN.revisions["synthesize"]
NEED = Requirements(Stage.SYNTHESIZE, OWN.schemas[0], OWN.schemas[1], REVISION)


def beat(
    *, schemas: tuple[int, int] = OWN.schemas, revision: int = REVISION, stage: Stage = Stage.SYNTHESIZE
) -> WorkerBeat:
    return beat_of(stages=(stage,), schemas=schemas, revisions={**OWN.revisions, "synthesize": revision})


NEXT = beat(revision=REVISION + 1)


@pytest.mark.parametrize(
    ("present", "need", "place"),
    [
        ([], NEED, Route()),
        ([beat()], NEED, Route()),
        ([beat(), beat(stage=Stage.SCENE, revision=1)], NEED, Route()),
        ([beat(), NEXT], NEED, Route(apart=True)),
        ([beat(), beat(schemas=(9, 9))], NEED, Route(apart=True)),
        ([beat(schemas=(2, 9)), beat(schemas=(2, 2))], replace(NEED, schema=3, newest=9), Route(apart=True)),
        ([beat(schemas=(4, 9))], replace(NEED, schema=2, newest=5), Route()),
    ],
)
def test_a_task_goes_where_those_look_who_can_do_it(
    present: list[WorkerBeat], need: Requirements, place: Route
) -> None:
    assert Routes(present).place(need) == place


@pytest.mark.parametrize(
    ("present", "need", "why"),
    [
        ([NEXT], NEED, f"revision {REVISION} of synthesize is needed, and revision {REVISION + 1} is made"),
        ([], replace(NEED, revision=1), "revision 1 of synthesize is needed"),
        ([beat(schemas=(2, 2))], replace(NEED, schema=3, newest=3), "schema 3 of tasks is needed, and 2 is the newest"),
        ([beat(schemas=(5, 6))], replace(NEED, newest=4), "schema 4 of tasks is the newest it may have"),
    ],
)
def test_what_nobody_can_do_is_held_back_with_the_reason(
    present: list[WorkerBeat], need: Requirements, why: str
) -> None:
    assert why in Routes(present).place(need).held


def test_a_task_asks_for_the_schema_of_its_newest_field() -> None:
    since = {"friction": 3, "touch": 4}
    assert needed_schema(request(), since) == OWN.schemas[0]
    assert needed_schema(request(friction=0.5), since) == 3
    assert needed_schema(request(friction=0.5, fidelity="draft"), {**since, "fidelity": 4}) == 4
    assert isinstance(request(), JobRequest)


def test_a_worker_that_does_not_say_what_it_can_is_given_no_task() -> None:
    now = beat()
    told = asdict(now)
    assert entries.read(WorkerBeat, json.dumps(told).encode()) == now
    for name in ("schemas", "revisions"):
        del told[name]
    old = entries.read(WorkerBeat, json.dumps(told).encode())
    assert old is not None and Routes([old]).place(NEED).held


def test_a_worker_looks_apart_only_for_what_it_can_do() -> None:
    names = queue_names([Stage.SYNTHESIZE], ability=OWN)
    apart = [f"interactive-synthesize.{schema}.{REVISION}" for schema in range(FIRST_SCHEMA, OWN.schemas[1] + 1)]
    assert names[: len(apart) + 1] == [*apart, "interactive-synthesize"]


def test_tasks_that_wait_apart_are_seen_and_leave(rq_queue: RqQueue) -> None:
    message = message_for()
    name = f"rq:queue:{queue_name(Priority.BULK, Stage.SYNTHESIZE, NEED)}"
    assert rq_queue.enqueue([message], Priority.BULK, apart=True) == 1
    assert rq_queue.connection.llen(name) == 1
    assert rq_queue.waiting() == {message.task_id}
    assert rq_queue.depths()[Priority.BULK, Stage.SYNTHESIZE] == 1
    assert rq_queue.now(lease_s=6).depth[Priority.BULK, Stage.SYNTHESIZE] == 1
    rq_queue.clear_untaken([beat(), NEXT])
    assert rq_queue.waiting() == {message.task_id}
    rq_queue.clear_untaken([NEXT])
    assert rq_queue.waiting() == set()
    assert known_lists(rq_queue.connection) == known_lists(rq_queue.connection)[:8]
    assert rq_queue.enqueue([message], Priority.BULK) == 1, "nothing of it is left"


def test_forged_names_of_lists_are_nobodys(rq_queue: RqQueue) -> None:
    forged = [f"rq:queue:bulk-synthesize.{n}.1" for n in range(200)]
    rq_queue.connection.sadd("rq:queues", "rq:queue:other.2.10", "rq:queue:bulk-synthesize.x.1", b"\xff", *forged)
    assert len(known_lists(rq_queue.connection)) == 8 + 64
    rq_queue.connection.set("rq:queues", "no set")
    assert len(known_lists(rq_queue.connection)) == 8
