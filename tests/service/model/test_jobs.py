"""Options of a job and the shards that they move; from jobs to tasks, from facts to states."""

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from graspd.service.model import planning
from graspd.service.model.digests import digest_json, job_id, shard_id
from graspd.service.model.domain import BATCH_SIZE, RECHECKS, SCENES, JobOptions, JobRequest
from graspd.service.model.metrics import (
    AXIS_MEANINGS,
    MIN_DISTANCE_M,
    ROBUST_MODELS,
    PerturbedParameter,
    perturbed_parameter_name,
)
from graspd.service.model.planning import (
    MAX_BACKOFF_S,
    OUTCOMES,
    TaskFacts,
    create_task_message,
    explain_shortfall,
    plan_tasks,
    sum_outcomes,
)
from graspd.service.model.records import DatasetMember, DatasetRecord, JobRecord
from graspd.service.model.renamed import original_request
from graspd.service.model.states import Priority, Stage, State
from graspd.service.model.version import STAGE_REVISIONS, TASK_SCHEMA
from graspd.service.pipeline.datasets.spec import create_record
from graspd.worker.planners.registry import PLANNERS, method
from tests.fakes import job_record, request

HAND, OBJECT = "a" * 32, "b" * 32
DIGESTS = {"hand_digest": HAND, "object_digest": OBJECT}


def record(wanted: JobRequest) -> JobRecord:
    return job_record(wanted, job_id(wanted, HAND, OBJECT))


def shard(stage: Stage, wanted: JobRequest) -> str:
    return shard_id(stage, request=wanted, batch=0, count=32, revision=1, **DIGESTS)


BASE = Stage.SYNTHESIZE


def test_options_of_the_method_make_another_shard_and_a_distance_of_candidates_none() -> None:
    plain, changed = request(method="graspit"), request(method="graspit", options={"steps": 40_000})
    assert shard(BASE, plain) != shard(BASE, changed)
    assert shard(Stage.SCENE, plain) == shard(Stage.SCENE, changed)
    raw = request(want="candidates")
    assert shard(BASE, request(want="candidates", min_distance=0.02)) == shard(BASE, raw)


def test_a_default_stays_out_of_documents_and_ids_and_another_value_moves_the_grasps() -> None:
    plain, document = request(), request().model_dump(mode="json")
    assert {"min_distance", "robust", "robust_models"}.isdisjoint(document)
    assert document == request(min_distance=MIN_DISTANCE_M).model_dump(mode="json")
    others = [request(min_distance=0.02), request(robust=0.5), request(robust_models=8)]
    assert len({job_id(one, HAND, OBJECT) for one in (plain, *others)}) == 4
    assert shard(BASE, others[0]) != shard(BASE, plain)
    assert [JobRequest.model_validate_json(one.model_dump_json()) for one in others] == others


def test_a_wanted_share_is_of_eight_models_unless_told() -> None:
    assert (request().model_count, request(robust=0.9).model_count) == (0, ROBUST_MODELS)
    assert request(robust=0.9, scene="table").model_count == ROBUST_MODELS, "in scenes as around free objects"
    assert request(robust=0.9, robust_models=16).model_count == request(robust_models=16).model_count == 16


def test_every_axis_has_its_words_and_no_other_number_has() -> None:
    assert set(AXIS_MEANINGS) == set(PerturbedParameter) - {PerturbedParameter.NONE}
    assert [perturbed_parameter_name(number) for number in (0, 1, 9, 10, 255)] == [None, "shapes", "order", None, None]


#: The DexGraspBench protocol takes 6 pushes of 2 s and 0.8 s of closing, 3,200 steps of MuJoCo; a valid grasp has cost
#: some 450 steps at level standard, which are a third of its time (docs/explanation/performance.md).
STEPS_OF_A_RECHECK, STEPS_OF_A_GRASP = 3200, 3 * 450


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("batches", [2, 3, 4, 9, 16, 40])
def test_audits_of_the_default_take_a_twentieth_of_a_jobs_time(seed: int, batches: int) -> None:
    job = request(seed=seed)
    rechecks = [job.rechecks_of(batch) for batch in range(batches)]
    assert sum(rechecks) <= RECHECKS and max(rechecks) <= 1
    # A job of an odd number of batches may be one ahead.
    even = batches - batches % 2
    price = sum(rechecks[:even]) * STEPS_OF_A_RECHECK / (even * BATCH_SIZE * STEPS_OF_A_GRASP)
    assert price <= 0.05


def test_half_of_many_short_jobs_are_rechecked_and_a_long_one_has_all() -> None:
    first = [request(seed=seed).rechecks_of(0) for seed in range(200)]
    assert 70 < sum(first) < 130
    assert {first[k] + request(seed=k).rechecks_of(1) for k in range(200)} == {1}
    for seed in range(6):
        assert sum(request(seed=seed).rechecks_of(batch) for batch in range(100)) == RECHECKS
    assert [request(rechecks=40).rechecks_of(batch) for batch in range(3)] == [32, 8, 0]
    assert request(rechecks=40, validation="dexgraspbench").rechecks_of(0) == 0


#: A job as it was written before jobs had scenes.
PLAIN: dict[str, Any] = (
    {"grasps": 32, "method": "fast_graspd", "fidelity": "standard", "seed": 0, "scenes": 0, "views": 0}
    | {"stereo": False, "width": 320, "height": 240, "channels": [], "friction": 1.0, "want": "valid", "budget": 4.0}
    | {"validation": "standard", "rechecks": 8, "options": {}, "target": ""}
)
PLANE, NAN = {"kind": "half_space"}, float("nan")


def test_a_job_without_a_scene_keeps_its_id_and_its_record() -> None:
    wanted = {**PLAIN, "hand": "gripper", "object": "ball"}
    job = record(request())
    assert job.request.model_dump(mode="json") == wanted
    revisions = {stage: revision for stage, revision in STAGE_REVISIONS.items() if stage != "episode"}
    said = {"request": original_request(wanted), "hand": HAND, "object": OBJECT, "revisions": revisions}
    assert job.id == digest_json(said)
    (task,) = plan_tasks(job)
    assert create_task_message(job, task, attempt=1, max_attempt=3).model_dump(mode="json")["request"] == wanted


MEMBERS = [DatasetMember(name="h", digest=HAND)], [DatasetMember(name="o", digest=OBJECT)]
DATASET = create_record("d", *MEMBERS, JobOptions(), lambda one: (one, None))


def test_a_dataset_without_a_scene_keeps_its_digest() -> None:
    options = {name: value for name, value in PLAIN.items() if name not in ("options", "target")}
    said = {"hands": [["h", HAND]], "objects": [["o", OBJECT]], "options": original_request(options)}
    assert DATASET.digest == digest_json(said)


@pytest.mark.parametrize(
    ("words", "lists"), [("a job", {"jobs": []}), ("a fidelity", {"fidelities": ["x"]}), ("reasons", {"chosen": [0]})]
)
def test_a_dataset_whose_lists_do_not_fit_its_cells_is_refused(words: str, lists: Any) -> None:
    with pytest.raises(ValidationError, match=f"a dataset has (the )?{words}"):
        DatasetRecord.model_validate(DATASET.model_dump() | lists)


def test_scenes_after_the_grasps_have_the_address_that_they_had() -> None:
    common = {"hand": HAND, "object": OBJECT, "names": ["gripper", "ball"], "batch": 1, "count": 32, "seed": 0}
    said = {**common, "stage": "scene", "revision": 2, "inputs": ["x"], "scenes": 3}
    of = {"batch": 1, "count": 32, "revision": 2, "inputs": ("x",)}
    assert digest_json(said) == shard_id(Stage.SCENE, request=request(scenes=3), **DIGESTS, **of)


def test_a_job_in_a_scene_makes_its_scenes_first() -> None:
    job = record(request(scene="table", views=2))
    assert job.id != record(request(scenes=SCENES, views=2)).id
    scene, base, views = plan_tasks(job)
    assert [task.stage for task in (scene, base, views)] == [Stage.SCENE, Stage.SYNTHESIZE, Stage.RENDER]
    assert (scene.inputs, base.inputs, views.inputs) == ((), (scene.output,), (base.output,))


def test_episodes_come_last_read_the_grasps_and_move_no_other_shard() -> None:
    plain = {"scene": "table", "views": 2}
    *others, episodes = plan_tasks(record(request(**plain, episodes="flying")))
    assert [task.output for task in others] == [task.output for task in plan_tasks(record(request(**plain)))]
    assert (episodes.stage, episodes.inputs) == (Stage.EPISODE, (others[1].output,))
    more = [{"episodes": "ur10e"}, {"film": ["wrist"]}, {"film": ["wrist", "scene"]}, {"episode_fps": 30}]
    made = [list(plan_tasks(record(request(**{"scene": "table", "episodes": "flying"} | one))))[-1] for one in more]
    assert len({episodes.output, *(task.output for task in made)}) == 1 + len(more)
    assert (
        planning.required_schema(request(**plain, episodes="flying"))
        == TASK_SCHEMA
        > planning.required_schema(request(**plain))
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("scene", "bin"), ("scene", {"supports": [PLANE]}), ("scenes", 5), ("faces", "all"), ("seed", 1)],
        *[("touch", 2), ("touch", -0.5), ("fidelity", "draft")],
    ],
)
def test_whatever_moves_scenes_gives_them_another_address(name: str, value: Any) -> None:
    first = next(plan_tasks(record(request(scene="table"))))
    assert next(plan_tasks(record(request(**{"scene": "table", name: value})))).output != first.output


def test_where_no_number_of_scenes_is_named_there_are_a_few() -> None:
    assert request(scene="table").scenes == request(scene="table", scenes="0").scenes == SCENES
    assert request(scene="table", scenes=7).scenes == 7
    assert request().scenes == 0


def test_a_document_comes_back_and_fingertips_may_touch_unless_it_says_otherwise() -> None:
    assert "touch" not in request(scene="table").model_dump()
    assert record(request(scene="table", touch=0)).id == record(request(scene="table")).id
    assert request(scene="table").scene_spec.touch == 0
    box = {"kind": "box", "size": [0.1, 0.2, 0.3]}
    document = {"supports": [PLANE, box], "touch": -0.5, "target": [0, 0, 1, 1, 0, 0, 0]}
    wanted = request(scene=document)
    assert (wanted.scene_spec.kind, len(wanted.scene_spec.supports), wanted.scene_spec.touch) == ("file", 2, -0.5)
    assert JobRequest.model_validate_json(wanted.model_dump_json()) == wanted
    assert request(scene=document, touch=2).scene_spec.touch == 2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scene": "tabel"}, "'free', 'table', 'bin' or 'shelf'"),  # codespell:ignore tabel
        ({"scene": {"supports": [{"kind": "half_space", "offset": NAN}]}}, "finite number"),
        ({"scene": {"supports": [PLANE], "file": "/etc/passwd"}}, "Extra inputs"),
        ({"scene": {"supports": [PLANE], "target": [0, 0, 0, 1, 0, 0, 0]}, "faces": "all"}, "lies on one face"),
        ({"faces": "all"}, "lies on no face"),
        ({"episodes": "flying"}, "free grasps have no episodes"),
        ({"scene": "table", "episodes": "flying", "validation": "none"}, "episodes execute valid grasps"),
        ({"scene": "table", "film": ["scene"]}, "film shows episodes"),
        ({"scene": "table", "episodes": "flying", "film": ["scene"], "width": 321}, "choose even numbers"),
        ({"touch": 1}, "no supports to touch"),
        ({"scene": "table", "touch": -1.5}, "greater than or equal to -1"),
        ({"scene": "table", "touch": NAN}, "finite number"),
        ({"scene": "table", "method": "dfc"}, "plans around free objects only"),
        ({"scene": "table", "method": "learned"}, "needs the option network"),
        ({"scene": "shelf", "method": "learned", "options": {"network": "n"}}, "objects on a table"),
        ({"method": "learned", "options": {"network": "n"}}, "objects on a table"),
        ({"scene": "table", "scenes": 65}, "less than or equal to 64"),
        ({"robust": 0.5, "validation": "none"}, "robust counts verdicts: choose a validator"),
        ({"scene": "table", "shake": True, "validation": "none"}, "shake is simulated by a validator"),
        ({"mass": 0.1, "density": 500}, "mass and density exclude each other"),
        ({"robust": 1.5}, "less than or equal to 1"),
        ({"robust": NAN}, "finite number"),
        ({"robust_models": 65}, "less than or equal to 64"),
        ({"min_distance": -0.001}, "greater than or equal to 0"),
        ({"min_distance": 0.2}, "less than or equal to 0.1"),
        ({"min_distance": NAN}, "finite number"),
        ({"options": {"x": NAN}}, "finite number"),
        ({"options": {"x": [1]}}, "valid integer"),
        ({"options": {"x" * 41: 1}}, "at most 40"),
        ({"options": {f"o{i}": i for i in range(17)}}, "at most 16"),
    ],
)
def test_nonsense_is_refused_in_a_line(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError) as refused:
        request(**changes)
    first = refused.value.errors()[0]["msg"]
    assert words in first and "\n" not in first


def test_the_methods_that_know_no_scene_are_those_of_the_engine() -> None:
    known = {name for name in PLANNERS if method(name).in_scenes and not method(name).files}
    taken = set()
    for name in PLANNERS:
        try:
            request(scene="table", method=name)
            taken.add(name)
        except ValidationError:
            pass
    assert taken == known


CHAIN = (Stage.SYNTHESIZE, Stage.SCENE, Stage.RENDER)
DONE, QUEUED, FAILED, GONE = State.SUCCEEDED, State.QUEUED, State.FAILED, State.CANCELLED
OVER = {"last_attempt": 3, "exhausted": True}


def test_a_job_is_cut_into_batches_of_32_and_only_what_was_asked_for_stage_by_stage() -> None:
    assert [(task.batch, task.count) for task in plan_tasks(record(request(grasps=70)))] == [(0, 32), (1, 32), (2, 6)]
    (alone,) = plan_tasks(record(request()))
    assert (alone.stage, alone.inputs) == (Stage.SYNTHESIZE, ())
    few, many = (list(plan_tasks(record(request(scenes=2, views=views)))) for views in (3, 4))
    assert [task.stage for task in few] == [*CHAIN]
    assert [task.inputs for task in few] == [(), (few[0].output,), (few[1].output,)]
    # More views are other pictures of the same grasps.
    assert [task.output for task in few[:2]] == [task.output for task in many[:2]]
    assert few[2].output != many[2].output
    assert {task.id for task in few}.isdisjoint({task.id for task in many})


@given(st.integers(1, 2000), st.integers(0, 2), st.integers(0, 2))
def test_a_plan_makes_each_grasp_once_and_names_nothing_twice(grasps: int, scenes: int, views: int) -> None:
    tasks = list(plan_tasks(record(request(grasps=grasps, scenes=scenes, views=views if scenes else 0))))
    assert sum(task.count for task in tasks if task.stage is Stage.SYNTHESIZE) == grasps
    assert len({task.id for task in tasks}) == len({task.output for task in tasks}) == len(tasks)


def test_a_small_job_is_interactive_and_a_large_one_is_bulk() -> None:
    assert planning.priority_of(request(grasps=32)) is Priority.INTERACTIVE
    assert planning.priority_of(request(grasps=100_000)) is Priority.BULK


@pytest.mark.parametrize(
    ("first", "cancelled", "states", "ready"),
    [
        ({}, False, [QUEUED] * 3, 0),
        ({"done": True}, False, [DONE, QUEUED, QUEUED], 1),
        (OVER, False, [FAILED, GONE, GONE], None),
        (OVER | {"retried_upto": 3}, False, [QUEUED] * 3, 0),
        (OVER | {"last_attempt": 6, "retried_upto": 3}, False, [FAILED, GONE, GONE], None),
        ({"done": True}, True, [DONE, GONE, GONE], None),
        (OVER | {"done": True}, False, [DONE, QUEUED, QUEUED], 1),
    ],
    ids=["new", "done", "failed", "retried", "failed after it", "cancelled", "a shard after a failure"],
)
def test_states_follow_from_facts(first: dict[str, Any], cancelled: bool, states: Any, ready: int | None) -> None:
    chain = [TaskFacts(stage, **(first if stage is CHAIN[0] else {})) for stage in CHAIN]
    found = planning.range_states(chain, job_cancelled=cancelled)
    assert found == states
    assert planning.range_ready_mask(found) == [place == ready for place in range(3)]


#: Of a job, by those of its tasks.
STATES = {"queued": "queued", "queued running": "running", "queued succeeded": "running", "succeeded": "succeeded"}
STATES |= {"queued failed cancelled": "running", "succeeded failed cancelled": "failed"}
STATES |= {"succeeded cancelled": "cancelled"}


@pytest.mark.parametrize(("tasks", "state"), STATES.items())
def test_the_state_of_a_job_follows_from_its_tasks(tasks: str, state: str) -> None:
    assert planning.job_state(map(State, tasks.split())) == state


def test_the_wait_doubles_up_to_a_bound() -> None:
    assert [planning.backoff(2.0, failures) for failures in (1, 2, 3)] == [2.0, 4.0, 8.0]
    assert planning.backoff(2.0, 1000) == MAX_BACKOFF_S


def test_why_fewer_grasps_were_found_is_told_the_most_frequent_first() -> None:
    assert explain_shortfall(request(grasps=8, budget=4), 8, 12, {"slipped": 4}) is None
    lost = sum_outcomes([{"slipped": 4, "no_place": 1}, {"slipped": 1, "turned": 2, "alike": 0, "fell_apart": 3}])
    assert lost == {"no_place": 1, "turned": 2, "slipped": 5, "fell_apart": 3}
    said = str(explain_shortfall(request(grasps=2, budget=4), 0, 8, lost))
    known = {name: f"{count} {OUTCOMES.get(name)}" for name, count in lost.items()}
    counts = f"{known['slipped']}, 3 fell apart, {known['turned']}, {known['no_place']}"
    assert said.startswith(f"found 0 of 2 valid grasps in 8 candidates: {counts}; the budget of 4 candidates")
    said = str(explain_shortfall(request(grasps=4, budget=4), 1, 7, {"not_lifted": 6, "repeated": 9}))
    assert said.startswith("found 1 of 4 valid grasps in 16 candidates: 9 repeated attempts, 6 not lifted; the budget")


def test_a_limit_of_the_hand_stands_where_the_budget_would() -> None:
    limit = planning.payload_limit_text("barrett", 0.6, 16, 5.66, math.inf, 100.0)
    assert limit == "barrett lifts 5.7 kg at friction 0.6 in the best of 16 grasps; 100 kg are wanted"
    said = str(explain_shortfall(request(grasps=4), 0, 4, {}, limit=limit))
    assert said == f"found 0 of 4 valid grasps in 4 candidates; {limit}"
