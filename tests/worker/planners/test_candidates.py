"""Which candidate of a grasp is taken after its trials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.model.domain import resolve_fidelity
from service.model.scene_spec import SceneSpec
from tests.worker.models import two_finger_hand
from tests.worker.quality.helpers import grasp_set, posture
from tests.worker.simulation.rigs import ball
from worker.grasps import GraspSet
from worker.hands.load import hand_from_path
from worker.objects.prepare import object_from_path
from worker.planners import Wanted, synthesize
from worker.planners.fast_graspd import candidates
from worker.quality.referee.decomposition import ConvexPieces
from worker.run import Run
from worker.scenes.kinds import rest_poses, supports_of
from worker.scenes.trial import lift_trial
from worker.simulation.state import HandState
from worker.simulation.surroundings import Obstacle, Placed

QUICK = resolve_fidelity("draft").model_copy(update={"starts": 2, "finalists": 2})
TABLE = (Obstacle.half_space([0, 0, 1], 0.0),)


def plain(hand, obj, state: HandState, losses: np.ndarray, placed: Placed) -> GraspSet:
    """Grasps that remember which hand they are by their loss, and their place in the batch by their scene."""
    rows = [((0.0, 0.0, 0.0), (0.0,) * hand.dofs) for _ in losses]
    return replace(grasp_set(posture(*rows)), stability_loss=losses)


def taken(scores: list[list[float]], monkeypatch: pytest.MonkeyPatch) -> tuple[list[int], list[int]]:
    """Rows that are taken where hand k of grasp n scores `scores[n][k]`, in this order; hands that were tried."""
    monkeypatch.setattr(candidates, "with_postures", plain)
    flat = np.ravel(scores)
    seen: list[int] = []

    def trial(grasps: GraspSet, placed: Placed) -> np.ndarray:
        rows = grasps.stability_loss.astype(int)
        assert (placed.index == rows // len(scores[0])).all()
        seen.extend(rows.tolist())
        return flat[rows]

    n, each = np.shape(scores)
    state = HandState(np.zeros((n * each, 3)), np.tile([1.0, 0, 0, 0], (n * each, 1)), np.zeros((n * each, 2)))
    placed = Placed(TABLE, np.tile([0, 0, 0, 1.0, 0, 0, 0], (n, 1)), np.arange(n))
    order = np.arange(n * each).reshape(n, each)
    rows, found = candidates.tried(
        two_finger_hand(), ball(), state, np.arange(n * each, dtype=float), order, placed, trial
    )
    assert found.stability_loss.tolist() == rows.tolist()
    return rows.tolist(), sorted(seen)


def test_the_first_that_is_good_enough_is_taken_and_nobody_after_it_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, seen = taken([[0.5, 0.1, 0.1], [3.0, 0.9, 0.1]], monkeypatch)
    assert rows == [0, 4]
    assert seen == [0, 3, 4]


def test_where_none_is_good_enough_the_least_score_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    assert taken([[3.0, 2.0, 4.0]], monkeypatch) == ([1], [0, 1, 2])


def test_of_equal_scores_the_one_of_better_merit_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    assert taken([[2.0, 2.0]], monkeypatch)[0] == [0]


@pytest.fixture(scope="module")
def scene():
    hand, obj = hand_from_path("barrett"), object_from_path("block", face_error_m=QUICK.face_error_m)
    spec = SceneSpec(kind="table")
    return (
        hand,
        obj,
        Placed(supports_of(spec), rest_poses(spec, obj, count=2, seed=1)["scene/object_pose"], np.arange(4) % 2),
    )


def test_a_trial_that_takes_all_comers_changes_no_grasp_and_neither_do_threads(scene) -> None:
    hand, obj, placed = scene
    wanted = Wanted(4, QUICK, seed=4, placed=placed)
    welcome = replace(wanted, trial=lambda grasps, placed: np.zeros(len(grasps)))
    plain = synthesize(hand, obj, wanted, Run(threads=1))
    assert np.array_equal(
        synthesize(hand, obj, welcome, Run(threads=1)).squeeze.joint_positions, plain.squeeze.joint_positions
    )
    pieces = ConvexPieces((obj.hull_vertices,), 1.0, 0.0, "block")
    lifting = replace(wanted, trial=lift_trial(hand, obj, lambda: pieces))
    one, two = (synthesize(hand, obj, lifting, Run(threads=threads)) for threads in (1, 4))
    assert np.array_equal(one.grasp.hand_pose, two.grasp.hand_pose)
    # The first candidates are the plain grasps: one that is taken from them scored better in its trial.
    trial = lift_trial(hand, obj, lambda: pieces)
    before, after = trial(plain, placed), trial(one, placed)
    changed = (one.grasp.hand_pose != plain.grasp.hand_pose).any(axis=1)
    assert (after[changed] < before[changed]).all()
    assert (before[~changed] == after[~changed]).all()
