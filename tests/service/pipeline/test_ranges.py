"""How many batches a task has, by what was measured and who is there, and which workers it waits for."""

import json
import math
from dataclasses import asdict, replace
from itertools import product
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from graspd.service.index.changes.records import Changes
from graspd.service.index.rebuild import differences
from graspd.service.model.messages import FIRST_SCHEMA, Requirements, WorkerHeartbeat, capabilities
from graspd.service.model.planning import required_schema
from graspd.service.model.records import JobRecord
from graspd.service.model.states import AssetKind, Priority, Stage, State
from graspd.service.model.version import SCHEMA_OF_RANGES, STAGE_REVISIONS, TASK_SCHEMA
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.job_actions import Route, Routes, TaskRanges, span_of
from graspd.service.queue import entries
from graspd.service.queue.entries import list_names, queue_name, queue_names
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.store.manifests import ShardManifest
from tests.fakes import OBJECT_FILES, beat_of, make_shard, message_for, plan_all, put_asset, request, with_settings
from tests.service.pipeline.test_controller import Bench

OWN = replace(capabilities(), engines=("drake",))
REVISION = OWN.revisions["synthesize"]
NEED = Requirements(Stage.SYNTHESIZE, OWN.schemas[0], OWN.schemas[1], REVISION)


def beat(
    schemas: tuple[int, int] = OWN.schemas,
    revision: int = REVISION,
    stage: Stage = NEED.stage,
    engines: tuple[str, ...] = (),
) -> WorkerHeartbeat:
    revisions = {**OWN.revisions, "synthesize": revision}
    return beat_of(stages=(stage,), schemas=schemas, revisions=revisions, engines=engines)


NEXT = beat(revision=REVISION + 1)
PHYSX = replace(NEED, engines=("physx",))


@pytest.mark.parametrize(
    ("present", "need", "place"),
    [
        ([], NEED, Route()),
        ([beat()], NEED, Route()),
        ([beat(), beat(stage=Stage.SCENE, revision=1)], NEED, Route()),
        ([beat(), NEXT], NEED, Route(apart=True)),
        ([beat(), beat(schemas=(OWN.schemas[1] + 1,) * 2)], NEED, Route(apart=True)),
        ([beat(schemas=(2, 9)), beat(schemas=(2, 2))], replace(NEED, schema=3, newest=9), Route(apart=True)),
        ([beat(schemas=(4, 9))], replace(NEED, schema=2, newest=5), Route()),
        ([beat(engines=("physx",)), beat(engines=("drake", "physx"))], PHYSX, Route()),
        ([beat(engines=("physx",)), beat()], PHYSX, Route(apart=True)),
    ],
)
def test_a_task_goes_where_able_workers_look(present: list[WorkerHeartbeat], need: Requirements, place: Route) -> None:
    assert Routes(present).route_of(need) == place


@pytest.mark.parametrize(
    ("present", "need", "why"),
    [
        ([NEXT], NEED, f"needs revision {REVISION} of synthesize, but the worker has revision {REVISION + 1}"),
        ([], replace(NEED, revision=1), "needs revision 1 of synthesize"),
        ([beat(schemas=(2, 2))], replace(NEED, schema=3, newest=3), "schema 3, but the worker reads at most schema 2"),
        ([beat(schemas=(5, 6))], replace(NEED, newest=4), "has at most schema 4"),
        ([beat(engines=("drake",))], PHYSX, "engine physx, which the worker lacks; run pip install 'graspd[physx]'"),
    ],
)
def test_what_nobody_can_do_is_held_with_the_reason(
    present: list[WorkerHeartbeat], need: Requirements, why: str
) -> None:
    assert why in Routes(present).route_of(need).held


def test_a_task_asks_for_the_schema_of_its_newest_field() -> None:
    since = {"friction": 3, "touch": 4}
    assert required_schema(request(), since) == OWN.schemas[0]
    assert required_schema(request(friction=0.5), since) == 3
    assert required_schema(request(friction=0.5, fidelity="draft"), {**since, "fidelity": 4}) == 4


def test_a_worker_that_does_not_say_what_it_can_is_given_no_task() -> None:
    now = beat()
    told = asdict(now)
    assert entries.parse_entry(WorkerHeartbeat, json.dumps(told).encode()) == now
    for name in ("schemas", "revisions"):
        del told[name]
    old = entries.parse_entry(WorkerHeartbeat, json.dumps(told).encode())
    assert old is not None and Routes([old]).route_of(NEED).held


def test_a_worker_looks_apart_only_for_what_it_can_do() -> None:
    names = queue_names([Stage.SYNTHESIZE], ability=OWN)
    apart = [f"interactive-synthesize.{schema}.{REVISION}" for schema in range(FIRST_SCHEMA, OWN.schemas[1] + 1)]
    # Only messages since the schema of engines name them.
    engines = [apart[-2], f"{apart[-2]}.drake", apart[-1], f"{apart[-1]}.drake"]
    assert names[: len(apart) + 3] == [*apart[:-2], *engines, "interactive-synthesize"]


def test_tasks_that_wait_apart_are_seen_and_leave(rq_queue: RqQueue) -> None:
    message = message_for(second_engine="drake")
    need = replace(NEED, schema=message.schema_, engines=("drake",))
    name = f"rq:queue:{queue_name(Priority.BULK, Stage.SYNTHESIZE, need)}"
    assert rq_queue.enqueue([message], Priority.BULK, apart=True) == 1
    assert rq_queue.connection.llen(name) == 1
    assert rq_queue.waiting_tasks() == {message.task_id}
    assert rq_queue.depths()[Priority.BULK, Stage.SYNTHESIZE] == 1
    assert rq_queue.status(lease_s=6).depth[Priority.BULK, Stage.SYNTHESIZE] == 1
    rq_queue.remove_unserved_lists([beat(engines=("drake",)), NEXT])
    assert rq_queue.waiting_tasks() == {message.task_id}
    rq_queue.remove_unserved_lists([beat(), NEXT])
    assert rq_queue.waiting_tasks() == set()
    assert list_names(rq_queue.connection) == list_names(rq_queue.connection)[: 2 * len(Stage)]
    assert rq_queue.enqueue([message], Priority.BULK) == 1, "nothing of it is left"


def test_forged_names_of_lists_are_nobodys(rq_queue: RqQueue) -> None:
    forged = [f"rq:queue:bulk-synthesize.{n}.1" for n in range(200)]
    rq_queue.connection.sadd("rq:queues", "rq:queue:other.2.10", "rq:queue:bulk-synthesize.x.1", b"\xff", *forged)
    assert len(list_names(rq_queue.connection)) == 2 * len(Stage) + 64
    rq_queue.connection.set("rq:queues", "no set")
    assert len(list_names(rq_queue.connection)) == 2 * len(Stage)


@pytest.fixture
def services(services: Services) -> Services:
    """A service whose tasks last half a minute."""
    return with_settings(services, task_s=30.0)


def worker(name: str = "w", *, device: str = "cpu", schemas: tuple[int, int] = (2, TASK_SCHEMA)) -> WorkerHeartbeat:
    return beat_of(name, device=device, schemas=schemas, revisions=dict(STAGE_REVISIONS))


def here(services: Services, *workers: WorkerHeartbeat) -> None:
    services.queue._workers = {one.name: one for one in workers}  # type: ignore[attr-defined]


def measured(services: Services, seconds: float) -> None:
    """A batch took so long."""
    made = make_shard(services.store, message_for(seed=99))
    services.index.write.add_manifests([made.model_copy(update={"seconds": seconds})])


def span(services: Services, grasps: int, priority: Priority = Priority.BULK, **changes: object) -> int:
    return job_actions.prepare_job(services, request(grasps=grasps, **changes), priority=priority).span


@given(st.integers(1, 40_000), st.integers(0, 5000), st.integers(0, 300))
def test_tasks_are_of_one_length_and_shared_evenly(batches: int, by_time: int, workers: int) -> None:
    found = span_of(batches, by_time, workers)
    assert 1 <= found <= max(1, min(64, by_time))
    tasks = math.ceil(batches / found)
    assert found * tasks - batches < tasks, "all but the last are full, and it lacks less than one batch a task"
    if workers:
        assert found <= math.ceil(batches / workers), "no worker waits while another has two"


def test_a_task_of_a_larger_job_lasts_as_the_settings_say(services: Services) -> None:
    here(services, worker())
    assert span(services, 32 * 100) == 4, "nothing was measured: a stored rate on two cores, 7 s a batch"
    # Half of what the fakes make is valid, so that a job of so many valid ones takes twice the candidates of a batch.
    measured(services, 0.5)
    assert 20 <= span(services, 32 * 1000) <= 40
    measured(services, 60.0)
    assert span(services, 32 * 1000) == 1


def test_workers_share_a_job_fairly(services: Services) -> None:
    measured(services, 0.01)
    here(services, *(worker(f"w{number}") for number in range(4)))
    assert span(services, 32 * 16) == 4
    here(services, worker("a"), worker("b"))
    assert span(services, 32 * 16) == 8
    here(services)
    assert span(services, 32 * 16) == 2, "a fleet may start once tasks wait"


@pytest.mark.parametrize(("cells", "tasks"), [(1, 4), (2, 2), (8, 1)])
def test_cells_of_a_dataset_share_the_workers(services: Services, cells: int, tasks: int) -> None:
    measured(services, 0.01)
    here(services, *(worker(f"w{number}") for number in range(4)))
    for number in range(1, cells):
        put_asset(services, AssetKind.OBJECT, f"ball{number}", {**OBJECT_FILES, "n": bytes([number])})
    objects = ("ball", *(f"ball{number}" for number in range(1, cells)))
    actions.create(services, DatasetRequest(name="d", hands=("gripper",), objects=objects, grasps=32 * 16))
    assert services.index.datasets.get("d").tasks == 16 * cells, "with a batch a task, until it is known"
    plan_all(services)
    assert services.index.datasets.get("d").tasks == tasks * cells
    assert {cell.tasks for cell in services.index.datasets.cells("d").items} == {tasks}


def test_small_jobs_pictures_and_older_workers_go_batch_by_batch(services: Services) -> None:
    measured(services, 0.01)
    here(services, worker())
    assert span(services, 128, Priority.INTERACTIVE) == 1
    here(services, worker(device="cuda:0"))
    assert span(services, 128, Priority.INTERACTIVE) == 4
    here(services, worker("a", device="cuda:0"), worker("b"))
    assert span(services, 128, Priority.INTERACTIVE) == 1
    here(services, worker())
    assert span(services, 3200, scenes=1, views=1) == 1
    assert span(services, 3200, scenes=1) > 1
    here(services, worker("new"), worker("old", schemas=(2, SCHEMA_OF_RANGES - 1)))
    assert span(services, 3200) == 1
    known = job_actions.prepare_job(services, request(grasps=3200, scenes=1, views=1))
    with pytest.raises(ValidationError, match="pictures"):
        JobRecord.model_validate({**known.model_dump(mode="json"), "span": 2})


def test_rates_and_workers_are_read_once_for_many_jobs(services: Services) -> None:
    here(services, worker())
    now = 0.0
    ranges = TaskRanges(services, clock=lambda: now)
    job = job_actions.prepare_job(with_settings(services, task_s=0.0), request(grasps=3200), priority=Priority.BULK)
    assert ranges.with_span(job).span == 4
    measured(services, 0.01)
    assert ranges.with_span(job).span == 4
    now = 60.0
    assert ranges.with_span(job).span > 4


def test_a_job_of_ranges_goes_through_its_stages(services: Services) -> None:
    bench = Bench(services)
    bench.controller.run_round()
    here(services, worker())
    job = job_actions.prepare_job(services, request(grasps=32 * 6 + 5, scenes=2), priority=Priority.BULK)
    assert job.span == 4
    job_actions.enter_job(services, job)
    bench.work_off()
    done = services.index.jobs.get(job.id)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 197)
    assert [stage.tasks for stage in done.stages] == [2, 2]
    shards = services.index.shards.page(job=job.id).items
    assert {(shard.stage, shard.batch) for shard in shards} == set(product((Stage.SYNTHESIZE, Stage.SCENE), (0, 4)))
    assert differences(services.index, services.store) == []


def test_large_shards_enter_the_index_in_short_turns(services: Services, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(services)
    bench.controller.run_round()
    record = job_actions.prepare_job(services, request(grasps=32 * 64 * 5), priority=Priority.BULK)
    job, _ = job_actions.enter_job(services, record.model_copy(update={"span": 64}))
    turns: list[int] = []
    add = Changes.add_manifests

    def counted(self: Changes, manifests: list[ShardManifest], **options: Any) -> dict[str, State]:
        turns.append(sum(manifest.batches for manifest in manifests))
        return add(self, manifests, **options)

    monkeypatch.setattr(Changes, "add_manifests", counted)
    while (delivery := bench.queue.take("w")) is not None:
        bench.do(delivery)
    bench.pass_time(1)
    assert services.index.jobs.get(job.id).state is State.SUCCEEDED
    assert turns == [256, 64]
