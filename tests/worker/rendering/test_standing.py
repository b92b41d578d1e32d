"""Supports before the cameras: where their boxes stand, how they are labelled, and that cameras see past them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd.service.model.scene_spec import Box, HalfSpace, SceneSpec, supports_in
from graspd.service.model.transforms import quat_rotate
from graspd.worker.rendering import Extras, render
from graspd.worker.rendering.scenery import TABLE, TABLE_SIZE, seen_share, slab_poses, slabs
from tests.worker.models import object_from_mesh

SPECS = {kind: supports_in(SceneSpec(kind=kind)) for kind in ("table", "bin", "shelf")}
POSE = np.array([[0, 0, 0.03, 1.0, 0, 0, 0]])


@pytest.fixture(scope="module")
def block():
    return object_from_mesh(trimesh.creation.box((0.05, 0.04, 0.06)), "block")


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (0, -2, 0), (1, 2, 3), (0, 0, -1)])
def test_the_top_of_a_half_spaces_slab_is_its_plane(normal):
    plane = HalfSpace(normal=normal, offset=0.12)
    (pose,) = slab_poses([plane], np.array([0.1, 0.05, 0.2]), 0.7)
    unit = np.asarray(normal, float) / np.linalg.norm(normal)
    top = pose[:3] + quat_rotate(pose[3:], np.array([0.2, -0.3, TABLE_SIZE[2] / 2]))
    # Rounding of a handful of products near 1.
    assert unit @ top == pytest.approx(0.12 / np.linalg.norm(normal), abs=1e-12)
    np.testing.assert_allclose(quat_rotate(pose[3:], np.array([0, 0, 1.0])), unit, atol=1e-12)


def test_a_box_keeps_its_size_and_its_pose():
    box = Box(size=(0.02, 0.4, 0.2), pose=(0.12, 0, 0.1, 1, 0, 0, 0))
    assert slabs([box])[0].size == (0.02, 0.4, 0.2)
    np.testing.assert_array_equal(slab_poses([box], np.zeros(3), 0.7)[0], box.pose)


def test_a_line_through_a_box_is_hidden_and_one_past_it_is_not():
    wall = [Box(size=(0.02, 0.4, 0.2), pose=(0.12, 0, 0.1, 1, 0, 0, 0))]
    points = np.array([[0, 0, 0.05], [0, 0, 0.5]])
    assert seen_share(wall, np.array([0.5, 0, 0.1]), points) == 0.5
    assert seen_share(wall, np.array([-0.5, 0, 0.1]), points) == 1.0
    assert seen_share(TABLE, np.array([0.5, 0, -0.1]), points) == 0.0


def test_a_point_on_a_board_is_seen_from_above_it():
    board = [Box(size=(0.4, 0.4, 0.02), pose=(0, 0, -0.01, 1, 0, 0, 0))]
    assert seen_share(board, np.array([0.5, 0, 0.4]), np.zeros((1, 3))) == 1.0


@pytest.mark.parametrize("kind", ["bin", "shelf"])
def test_every_camera_sees_the_object_past_walls_and_boards(block, kind):
    views = render(
        block, POSE, views=4, stereo=False, width=48, height=36, seed=3, samples=2, extras=Extras(supports=SPECS[kind])
    )
    seen = np.asarray(views["image/segmentation"]) == 2
    assert (seen.sum(axis=(1, 2)) > 20).all()


def test_all_supports_are_labelled_as_the_table(block):
    views = render(
        block,
        POSE,
        views=2,
        stereo=False,
        width=48,
        height=36,
        seed=3,
        samples=2,
        extras=Extras(supports=SPECS["bin"], channels=("occlusion",)),
    )
    assert set(np.unique(views["image/segmentation"])) <= {0, 1, 2}
    assert (np.asarray(views["image/segmentation"]) == 1).mean() > 0.2
    assert np.isfinite(views["box/occlusion_ratio"]).all()


def test_a_table_looks_the_same_named_or_not(block):
    options = {"views": 1, "stereo": False, "width": 48, "height": 36, "seed": 3, "samples": 2}
    named = render(block, POSE, **options, extras=Extras(supports=SPECS["table"]))
    np.testing.assert_array_equal(named["image/rgb"], render(block, POSE, **options)["image/rgb"])
