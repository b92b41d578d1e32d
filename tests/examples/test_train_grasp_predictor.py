"""The example that trains a grasp predictor: its rows, what it compares networks with, and how proposals are lifted."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples.train_grasp_predictor import execution
from examples.train_grasp_predictor.evaluation import OBJECT, Exam, examined
from examples.train_grasp_predictor.samples import Scene, Sight, each_scene, rows_of, sights, taught
from examples.train_grasp_predictor.without_network import SQUEEZE, across
from graspd.baselines.learned.network import Proposals, decode
from graspd.service.model.transforms import apply, compose, invert, quat_from_axis_angle, quat_rotate, quat_to_matrix
from graspd.service.readers import open_shards
from graspd.worker.engines import backend
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.prepare import object_from_path
from tests.api.factories import poses
from tests.service.readers import box_scenes

Floats = np.ndarray[Any, np.dtype[np.float64]]


@pytest.fixture(scope="module")
def hand() -> HandModel:
    backend.start_warp()
    return hand_from_path("barrett")


def grasps_of(rng: np.random.Generator, count: int = 5) -> GraspSet:
    roots = poses(rng, count)
    grasp, pregrasp, squeeze = (Posture(roots, rng.normal(size=(count, 3))) for _ in range(3))
    approach = np.repeat(roots[:, None], 4, axis=1)
    approach[..., :3] += np.linspace(0.1, 0, 4)[:, None] * np.array([0.0, 0.6, 0.8])
    return GraspSet(grasp, pregrasp, squeeze, np.zeros(count), approach=approach)


def block_of(size: tuple[float, float, float], *, turned: float = 0.0, at: tuple[float, float] = (0.0, 0.0)) -> Sight:
    rng = np.random.default_rng(3)
    half = np.array(size) / 2
    points = rng.uniform(-1, 1, (600, 3))
    points[np.arange(600), rng.integers(0, 3, 600)] = rng.choice([-1.0, 1.0], 600)
    pose = np.array([*at, half[2], *quat_from_axis_angle(np.array([0, 0, 1.0]), np.array(turned))])
    there = apply(pose, points * half)
    normals = np.tile([0, 0, 1.0], (600, 1))
    return Sight(Scene("block", "a" * 64, 0), there, normals, pose)


def test_a_row_is_its_grasp_where_the_object_lies() -> None:
    rng = np.random.default_rng(7)
    grasps, lying = grasps_of(rng), poses(rng, 1)[0]
    found = decode(rows_of(grasps, np.repeat(lying[None], 5, axis=0)), np.zeros(3))
    expected = compose(lying, grasps.grasp.hand_pose)
    np.testing.assert_allclose(found.hand_pose[:, :3], expected[:, :3], atol=1e-12)
    np.testing.assert_allclose(quat_to_matrix(found.hand_pose[:, 3:]), quat_to_matrix(expected[:, 3:]), atol=1e-12)
    np.testing.assert_allclose(found.approach, np.tile(quat_rotate(lying[3:], [0, -0.6, -0.8]), (5, 1)), atol=1e-12)
    for part in ("pregrasp", "squeeze"):
        np.testing.assert_allclose(getattr(found, part), getattr(grasps, part).joint_positions, atol=1e-12)


def test_points_seen_lie_on_the_object_and_valid_grasps_are_taught(tmp_path: Path) -> None:
    box_scenes.write(tmp_path)
    seen = sights(open_shards(tmp_path), noise="structured_light")
    assert len(seen) == box_scenes.VIEWS
    for sight in seen:
        inside = np.abs(apply(invert(sight.object_pose), sight.points))
        # 3 standard deviations of the noise at half a metre, and the bleeding of edges.
        assert np.quantile((inside - box_scenes.SIZE / 2).max(axis=1), 0.9) < 0.006
        np.testing.assert_allclose(sight.object_pose, box_scenes.POSES[sight.scene.number])
    found = taught(open_shards(tmp_path), "box")
    assert [scene.number for scene in found.scenes] == box_scenes.SCENE_OF_GRASP[box_scenes.VALID == 1].tolist()
    assert {scene.number: len(rows) for scene, rows in each_scene(found)} == {0: 3, 1: 2}


def test_without_a_network_fingers_close_across_the_narrow_side(hand: HandModel) -> None:
    sight = block_of((0.18, 0.05, 0.12), turned=0.7, at=(0.1, -0.05))
    found = across(hand, sight, 4, squeeze=SQUEEZE, rng=np.random.default_rng(0))
    ready = execution.made_ready(hand, found, sight)
    narrow = quat_rotate(sight.object_pose[3:], np.array([0, 1.0, 0]))
    for pose, grasp in zip(ready.hands.hand_pose, ready.hands.joints, strict=True):
        points = execution.hand_points(hand, pose[None], grasp[None])[0]
        low = (points[points[:, 2] < 0.11] - sight.anchor) @ narrow  # of the fingers, below the top of the block
        assert low.min() < -0.02
        assert low.max() > 0.02


def test_a_hand_that_would_stand_in_the_table_is_raised(hand: HandModel) -> None:
    sight = block_of((0.06, 0.06, 0.05))
    given = across(hand, sight, 2, squeeze=SQUEEZE, rng=np.random.default_rng(0))
    pose = given.hand_pose.copy()
    pose[:, 2] -= 0.03
    low = Proposals(pose, given.approach, given.joints, given.pregrasp, given.squeeze)
    ready = execution.made_ready(hand, low, sight)
    assert ready.table.all()
    lowest = execution.hand_points(hand, ready.hands.hand_pose, ready.hands.joints)[..., 2].min()
    assert lowest > -1e-3  # fingertips may touch the table; points of the surface are known to less than that


@pytest.mark.parametrize(("off", "clear"), [(0.5, False), (2.0, True)])
def test_a_hand_is_clear_that_keeps_its_distance_on_its_way(hand: HandModel, off: float, clear: bool) -> None:
    sight = block_of((0.06, 0.06, 0.12))
    given = across(hand, sight, 1, squeeze=SQUEEZE, rng=np.random.default_rng(0))
    ready = execution.made_ready(hand, given, sight)
    assert ready.clear.all()
    coming = execution.way_in(ready.hands)[0]
    swept = execution.hand_points(hand, coming, np.repeat(ready.opened, len(coming), axis=0)).reshape(-1, 3)
    # The outermost point of the way, and a thing that a camera saw beside it.
    side = swept[np.argmax(swept[:, 0])] + [off * execution.SEEN_M, 0.0, 0.0]
    beside = replace(sight, points=np.vstack([sight.points, side]), normals=np.vstack([sight.normals, [1.0, 0, 0]]))
    assert execution.made_ready(hand, given, beside).clear.all() == clear


@pytest.mark.slow
def test_a_block_is_lifted_by_a_hand_across_it_alone(hand: HandModel) -> None:
    block = object_from_path("block")
    scene = Sight(Scene("block", "a" * 64, 0), *_block_seen(block.vertices))
    exam = Exam.of("block", OBJECT, block, [scene] * 2, 2)

    def beside(sight: Sight, count: int, rng: np.random.Generator) -> Proposals:
        given = across(hand, sight, count, squeeze=SQUEEZE, rng=rng)
        pose = given.hand_pose.copy()
        pose[:, 0] += 0.3
        return Proposals(pose, given.approach, given.joints, given.pregrasp, given.squeeze)

    def over(sight: Sight, count: int, rng: np.random.Generator) -> Proposals:
        return across(hand, sight, count, squeeze=SQUEEZE, rng=rng)

    found = [next(examined(hand, [exam], proposer, seed=0, epsilon=False))[1] for proposer in (over, beside)]
    lifted, missed = (one["lift"] for one in found)
    assert lifted >= 0.5
    assert missed == 0.0


def _block_seen(vertices: Floats) -> tuple[Floats, Floats, Floats]:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    whole = block_of(tuple(high - low))
    pose = np.array([0, 0, -low[2], 1.0, 0, 0, 0])
    middle = (low + high) / 2
    return whole.points + np.array([middle[0], middle[1], 0.0]), whole.normals, pose
