"""Batches of valid grasps: the context of their work, rounds, budgets, rechecks, and the columns of a base shard."""

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from graspd.service.model.cores import available_cores
from graspd.service.model.domain import JobOptions, JobRequest
from graspd.service.model.errors import InputError, TaskCancelled
from graspd.service.model.metrics import MIN_DISTANCE_M, PerturbedParameter
from graspd.service.store.columns import SCHEMAS, check_attributes
from graspd.worker import generation
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.provenance import base_attributes
from graspd.worker.generation import ValidatedBatch, validated_grasps
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import PlanRequest
from graspd.worker.quality.diversity import grasp_distances, hand_points
from graspd.worker.rounds import next_round, select_rows
from graspd.worker.validation.protocol import Outcome
from graspd.worker.validation.robust import Robustness
from tests.worker.models import object_from_mesh, two_finger_hand

COUNT = 6
BLOCK = object_from_path("block")
SOME, JOINTS = 3, 2


@pytest.fixture(scope="module")
def hand():
    return hand_from_path("allegro")


def wish(**changes) -> JobRequest:
    return JobRequest(**{"hand": "allegro", "object": "block", "grasps": COUNT, "fidelity": "draft", **changes})


@pytest.fixture(scope="module")
def valid(hand) -> ValidatedBatch:
    return validated_grasps(hand, BLOCK, wish(rechecks=2), count=COUNT)


def test_a_batch_of_valid_grasps_holds_nothing_else(valid: ValidatedBatch) -> None:
    assert len(valid.grasps) == COUNT
    assert all((valid.columns[f"quality/{name}"] == 1).all() for name in ("valid", "feasible", "success"))
    assert all(len(array) == COUNT for path, array in valid.columns.items() if path != "quality/thresholds_m")
    assert valid.candidates == COUNT + sum(valid.rejected.values()) and valid.planned >= valid.candidates
    assert (valid.columns["quality/recheck"] >= 0).tolist() == [True] * 2 + [False] * (COUNT - 2)
    assert "quality/robust_share" not in valid.columns and "not_robust" not in valid.rejected


def judge(monkeypatch: pytest.MonkeyPatch, *pushes: Outcome, feasible: bool) -> None:
    """Verdicts repeat these outcomes of the third push, and the gate passes all grasps or none."""

    def verdicts(_hand, _obj, grasps: GraspSet, **__) -> SimpleNamespace:
        outcome = np.full((len(grasps), 6), Outcome.HELD, np.uint8)
        outcome[:, 2] = np.resize(pushes, len(grasps))
        held = (outcome[:, 2] == Outcome.HELD).astype(np.int8)
        return SimpleNamespace(success=held, outcome=outcome, margin=np.zeros(len(grasps)), seconds=0.0)

    monkeypatch.setattr(generation, "validate", verdicts)
    gate = lambda columns: np.full(len(columns["quality/success"]), feasible, np.uint8)  # noqa: E731
    monkeypatch.setattr(generation, "passes_gate", gate)


def test_tries_count_up_to_the_last_grasp_that_is_kept(hand, monkeypatch) -> None:
    judge(monkeypatch, Outcome.HELD, Outcome.DISPLACED, feasible=True)
    found = validated_grasps(hand, BLOCK, wish(rechecks=0), count=COUNT)
    # Six tries hold at 0, 2, 4; of the seven that promise to be enough the ones at 0, 2, 4 are.
    assert (found.candidates, found.planned, found.rejected["dropped"]) == (6 + 5, 6 + 7, 3 + 2)


def test_what_the_validator_saw_of_each_try_is_counted(hand, monkeypatch) -> None:
    seen = (Outcome.HELD, Outcome.DISPLACED, Outcome.ROTATED, Outcome.LOST_WHILE_CLOSING, Outcome.PENETRATION)
    judge(monkeypatch, *seen, feasible=False)
    request, run = wish(rechecks=0, grasps=5, budget=1), ExecutionContext(threads=1)
    found = validated_grasps(hand, BLOCK, request, count=5, run=run)
    ends = Counter("gate" if name.startswith("gate_") else name for name in Counter(found.outcomes).elements())
    assert ends == {"slipped": 1, "turned": 1, "lost_while_closing": 1, "penetration": 1, "gate": 1}
    assert (found.rejected["dropped"], found.rejected["gate"], found.candidates) == (4, 1, 5)


@pytest.mark.parametrize("after", [0, 1])
def test_a_batch_that_is_stopped_is_what_was_validated_before(hand, monkeypatch, after: int) -> None:
    rounds, real = [], generation.Batch.run_round

    def counted(*given):
        if len(rounds) == after:
            raise TaskCancelled("stopped")
        rounds.append(real(*given))
        rounds[-1].grasps, rounds[-1].columns = select_rows(rounds[-1].grasps, rounds[-1].columns, np.arange(1))
        rounds[-1].rows = rounds[-1].rows[:1]
        return rounds[-1]

    monkeypatch.setattr(generation.Batch, "run_round", counted)
    if not after:
        with pytest.raises(TaskCancelled):
            validated_grasps(hand, BLOCK, wish(rechecks=0), count=COUNT, partial=True)
        return
    found = validated_grasps(hand, BLOCK, wish(rechecks=0), count=COUNT, partial=True)
    assert len(found.grasps) == 1 and found.verdict_key is not None


def test_a_grasp_like_one_that_is_kept_makes_room_for_another(hand, monkeypatch) -> None:
    real = generation.synthesize

    def twins(*given, **named) -> GraspSet:
        found = real(*given, **named)
        return found.take(np.arange(len(found)) // 2 * 2)  # each grasp twice

    monkeypatch.setattr(generation, "synthesize", twins)
    plain = {"validation": "none", "fidelity": "draft", "budget": 8}
    found = validated_grasps(hand, BLOCK, wish(**plain), count=COUNT)
    points = hand_points(hand, found.grasps.grasp)
    rows, others = np.triu_indices(len(points), 1)
    assert len(found.grasps) == COUNT and grasp_distances(points, rows, others).min() >= MIN_DISTANCE_M
    assert found.rejected["alike"] >= COUNT - 1
    assert validated_grasps(hand, BLOCK, wish(**plain, min_distance=0), count=COUNT).rejected["alike"] == 0


def test_candidate_grasps_are_all_kept_with_their_verdicts(hand) -> None:
    found = validated_grasps(hand, BLOCK, wish(want="candidates", rechecks=0), count=COUNT)
    assert (len(found.grasps), found.candidates, set(found.rejected.values())) == (COUNT, COUNT, {0})
    assert set(np.unique(found.columns["quality/success"])) <= {0, 1}
    assert ((found.columns["quality/valid"] == 1) <= (found.columns["quality/success"] == 1)).all()


def test_without_a_validator_nobody_judges(hand) -> None:
    found = validated_grasps(hand, BLOCK, wish(validation="none"), count=COUNT)
    assert found.verdict_key is None and "quality/success" not in found.columns and len(found.grasps) == COUNT
    assert (found.columns["quality/feasible"] == 1).all(), "the budget is for feasible grasps then"
    assert not found.columns["quality/valid"].any()


def test_the_methods_own_options_reach_it(hand) -> None:
    wanted = {"method": "autograsp", "want": "candidates", "validation": "none"}
    wishes = (wish(**wanted, options={"standoff_m": gap}) for gap in (0.0, 0.05))
    near, far = (validated_grasps(hand, BLOCK, one, count=2) for one in wishes)
    assert not np.allclose(near.grasps.grasp.hand_pose, far.grasps.grasp.hand_pose)
    with pytest.raises(InputError, match="its options: standoff_m"):
        validated_grasps(hand, BLOCK, wish(**wanted, options={"speed": 3}), count=2)


def test_a_budget_that_finds_nothing_ends_with_nothing(hand, monkeypatch) -> None:
    planned: list[int] = []

    def plan(_hand, _obj, wanted: PlanRequest, *_, **__) -> GraspSet:
        count = wanted.count
        planned.append(wanted.batch)
        posture = Posture(np.tile([0.0, 0, 1, 1, 0, 0, 0], (count, 1)), np.zeros((count, len(hand.joint_names))))
        return GraspSet(posture, posture, posture, np.full(count, np.nan))

    monkeypatch.setattr(generation, "synthesize", plan)
    judge(monkeypatch, Outcome.DISPLACED, feasible=True)
    found = validated_grasps(hand, BLOCK, wish(budget=3.0), count=COUNT)
    assert (len(found.grasps), found.candidates) == (0, 3 * COUNT)
    assert len(set(planned)) == len(planned), "each round draws other grasps"
    assert found.columns["quality/valid"].shape == (0,)


def test_hands_that_are_no_numbers_are_dropped_and_counted(hand, monkeypatch) -> None:
    whole = generation.synthesize

    def plan(*arguments, **options) -> GraspSet:
        made = whole(*arguments, **options)
        made.grasp.hand_pose[::2] = np.nan
        return made

    monkeypatch.setattr(generation, "synthesize", plan)
    found = validated_grasps(hand, BLOCK, wish(want="candidates", validation="none"), count=COUNT)
    assert (len(found.grasps), found.candidates, found.rejected["diverged"]) == (COUNT // 2, COUNT, COUNT // 2)
    assert np.isfinite(found.grasps.grasp.hand_pose).all()


@given(wanted=st.integers(1, 32), factor=st.floats(1, 100), rates=st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_rounds_end_with_enough_grasps_or_with_budget_used_up(wanted: int, factor: float, rates: list[float]) -> None:
    budget = int(np.ceil(wanted * factor))
    valid = candidates = number = 0
    while size := next_round(wanted, valid, candidates, budget):
        candidates += size
        valid += int(size * rates[number % len(rates)])
        number += 1
        assert size > 0
    assert candidates <= budget
    assert valid >= wanted or candidates == budget


def test_only_grasps_that_hold_in_enough_models_count(hand) -> None:
    found = validated_grasps(hand, BLOCK, wish(robust=0.75, robust_models=4, rechecks=0), count=3)
    share, weakest = found.columns["quality/robust_share"], found.columns["quality/robust_weakest"]
    assert len(found.grasps) == 3 and (share >= 0.75).all()
    assert weakest.dtype == np.uint8 and ((weakest == 0) | (share < 1)).all()
    assert (found.columns["quality/valid"] == 1).all()
    assert found.candidates == 3 + sum(found.rejected.values()) and "not_robust" in found.rejected


def test_valid_grasps_that_hold_in_no_other_model_are_told_apart(hand, monkeypatch) -> None:
    def nowhere(*args, held: np.ndarray, models: int, wanted: float, **kwargs) -> Robustness:
        verdicts = np.where(held[:, None], 0, -1).astype(np.int8) * np.ones((1, models), np.int8)
        return Robustness(verdicts, np.full(verdicts.shape, PerturbedParameter.POSE, np.uint8), wanted, 0.0)

    monkeypatch.setattr(generation, "validate_robustness", nowhere)
    none = validated_grasps(hand, BLOCK, wish(robust=0.5, budget=1, rechecks=0), count=4)
    assert len(none.grasps) == 0 and none.rejected["not_robust"] > 0
    raw = validated_grasps(hand, BLOCK, wish(robust=0.5, want="candidates", rechecks=0), count=4)
    held = raw.columns["quality/success"] == 1
    assert (raw.columns["quality/robust_share"][held] == 0).all() and len(raw.grasps) == 4
    assert (raw.columns["quality/robust_weakest"][held] == PerturbedParameter.POSE).all()
    assert raw.columns["quality/valid"].any(), "a grasp that is not robust is valid all the same"


def test_a_part_fills_its_share_and_a_quiet_one_can_be_stopped() -> None:
    told: list[tuple[float, float, str]] = []
    run = ExecutionContext("cuda:7", 3, lambda *what: told.append(what), lambda: True)
    part = run.with_progress_range(0.5, 1.0).with_progress_range(0.0, 0.5)
    part.progress(1, 2, "half")
    part.progress(5, 5, "whole")
    part.progress(0, 0, "of nothing")
    assert told == [(0.625, 1.0, "half"), (0.75, 1.0, "whole"), (0.5, 1.0, "of nothing")]
    assert (part.device, part.threads, part.cancelled()) == ("cuda:7", 3, True)
    told.clear()
    run = ExecutionContext(progress=lambda *what: told.append(what), cancelled=lambda: True).without_progress()
    run.progress(1, 1, "done")
    assert not told
    with pytest.raises(TaskCancelled, match="the work was cancelled"):
        run.check("the work")


def test_without_number_of_threads_it_takes_the_cores_there_are() -> None:
    assert (ExecutionContext().cores, ExecutionContext(threads=3).cores) == (available_cores(), 3)


def postures(rng: np.random.Generator) -> Posture:
    return Posture(rng.normal(size=(SOME, 7)), rng.normal(size=(SOME, JOINTS)))


def some(*, in_scenes: bool) -> GraspSet:
    rng = np.random.default_rng(3)
    found = GraspSet(postures(rng), postures(rng), postures(rng), rng.normal(size=SOME))
    if in_scenes:
        found.scene = np.array([2, 0, 1])
        found.approach, found.coming = rng.normal(size=(SOME, 4, 7)), rng.normal(size=(SOME, JOINTS))
        found.lift = Posture(rng.normal(size=(SOME, 7)), found.squeeze.joint_positions)
    return found


@pytest.mark.parametrize("in_scenes", [False, True])
def test_grasps_come_back_from_the_columns_they_went_into(in_scenes: bool) -> None:
    grasps = some(in_scenes=in_scenes)
    columns = grasps.to_columns()
    assert set(columns) <= set(SCHEMAS["base"])
    back = GraspSet.from_columns({**columns, "quality/stability_loss": grasps.stability_loss})
    np.testing.assert_array_equal(back.stability_loss, grasps.stability_loss)
    assert back.to_columns().keys() == columns.keys()
    for path, array in back.to_columns().items():
        np.testing.assert_array_equal(array, columns[path])
    if in_scenes:
        np.testing.assert_array_equal(back.lift.joint_positions, grasps.lift.joint_positions)


@pytest.mark.parametrize(("key", "level"), [("k", "dexgraspbench"), (None, "none")])
def test_a_base_shard_says_who_validated_its_grasps(key: str | None, level: str) -> None:
    box, asked = object_from_mesh(trimesh.creation.box((0.05, 0.05, 0.05))), JobOptions(validation="dexgraspbench")
    said = base_attributes(two_finger_hand(), box, asked, candidates=7, verdict_key=key)
    check_attributes("base", said)
    assert said["verdict_level"] == level and said.get("verdict_key") == key and said["candidates"] == 7


@pytest.mark.parametrize(
    ("kind", "said"), [("base", {"colour": "red"}), ("views", {"mu": 1.0}), ("base", {"candidates": "many"})]
)
def test_attributes_that_the_schema_does_not_have_are_refused(kind: str, said: dict[str, str]) -> None:
    with pytest.raises(InputError, match=next(iter(said))):
        check_attributes(kind, said)
