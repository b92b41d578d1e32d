"""Scenes of every kind: the object stands on its support and in nothing else."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import quat_rotate
from graspd.worker.scenes.kinds import rest_poses, supports_of
from tests.worker.models import object_from_mesh

BLOCK = object_from_mesh(trimesh.creation.box((0.05, 0.07, 0.11)), "block")


def corners(pose: np.ndarray) -> np.ndarray:
    return quat_rotate(pose[3:], BLOCK.hull_vertices) + pose[:3]


@pytest.mark.parametrize("kind", ["table", "bin", "shelf"])
def test_the_object_stands_on_its_support_and_in_nothing_else(kind: str) -> None:
    spec = SceneSpec(kind=kind)
    for pose in rest_poses(spec, BLOCK, count=6, seed=3)["scene/object_pose"]:
        distances = [support.distance(corners(pose)).min() for support in supports_of(spec)]
        assert min(distances) == pytest.approx(0.0, abs=1e-6), "rest poses are exact"
        assert sorted(distances)[1:] == sorted(d for d in distances if d > 1e-4)[-len(distances) + 1 :]


def test_the_same_seed_gives_the_same_scenes() -> None:
    first, second = (rest_poses(SceneSpec(kind="bin"), BLOCK, count=3, seed=5) for _ in range(2))
    assert np.array_equal(first["scene/object_pose"], second["scene/object_pose"])


def test_all_faces_of_a_block_are_its_six() -> None:
    found = rest_poses(SceneSpec(kind="table", faces="all"), BLOCK, count=1, seed=0)
    heights = sorted(np.round(2 * found["scene/object_pose"][:, 2], 6).tolist())
    # The block's frame stands in its middle. A narrow end is a face that few drops end on.
    assert set(heights) <= {0.05, 0.07, 0.11}
    assert {0.05, 0.07} <= set(heights)
    assert len(heights) == len({tuple(np.round(p[3:], 6)) for p in found["scene/object_pose"]})


def test_an_object_too_large_for_a_bin_is_refused_with_both_sizes() -> None:
    plank = object_from_mesh(trimesh.creation.box((0.5, 0.05, 0.05)), "plank")
    with pytest.raises(InputError, match=r"plank lies .* mm and there is room for 380 x 280 mm"):
        rest_poses(SceneSpec(kind="bin"), plank, count=2, seed=0)


def test_a_target_under_its_support_is_refused() -> None:
    spec = SceneSpec(kind="file", supports=({"kind": "half_space"},), target=(0, 0, 0, 1, 0, 0, 0))
    with pytest.raises(InputError, match="deep in support 0"):
        rest_poses(spec, BLOCK, count=1, seed=0)


def test_a_target_with_a_pose_stands_there_in_every_scene() -> None:
    spec = SceneSpec(kind="file", supports=({"kind": "half_space"},), target=(0.1, 0, 0.055, 1, 0, 0, 0))
    found = rest_poses(spec, BLOCK, count=2, seed=0)["scene/object_pose"]
    assert np.array_equal(found, np.tile([0.1, 0, 0.055, 1, 0, 0, 0], (2, 1)))


def test_all_faces_are_those_that_enough_drops_end_on() -> None:
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=2, radius=0.03), "ball")
    found = rest_poses(SceneSpec(kind="table", faces="all"), ball, count=1, seed=0)
    # Of 320 alike faces 64 drops meet most once, which is no more than 1.6 %.
    assert 1 <= len(found["scene/object_pose"]) <= 20
