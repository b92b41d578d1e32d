"""Pictures for people: what must be in them; how they look is for people to validate."""

from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh
from PIL import Image

from graspd.worker.rendering import render
from graspd.worker.rendering.pictures import THREE_SIDES, grasp_pictures
from graspd.worker.rendering.sheets import (
    GAP,
    MARGIN,
    PAPER,
    best,
    contact_sheet,
    depth_colours,
    figures,
    three_sides_sheet,
    views_page,
)
from tests.worker.models import object_from_mesh, two_finger_hand

HAND = two_finger_hand()
POSES = np.array([[0, 0, -0.06, 1.0, 0, 0, 0], [0, 0, 0.06, 0, 1.0, 0, 0]])
JOINTS = np.array([[0.1, 0.1], [0.3, 0.3]])


@pytest.fixture(scope="module")
def block():
    return object_from_mesh(trimesh.creation.box((0.05, 0.04, 0.06)), "block")


@pytest.fixture(scope="module")
def pictures(block) -> np.ndarray:
    return grasp_pictures(HAND, block, POSES, JOINTS, (80, 64), THREE_SIDES, samples=4)


def hues(picture: np.ndarray) -> np.ndarray:
    hsv = np.asarray(Image.fromarray(picture).convert("HSV")).reshape(-1, 3).astype(int)
    return hsv[(hsv[:, 1] > 90) & (hsv[:, 2] > 30)][:, 0]


def test_every_grasp_is_shown_from_every_side(pictures):
    assert pictures.shape == (2, 3, 64, 80, 3)
    assert len({picture.tobytes() for picture in pictures.reshape(6, -1)}) == 6


def test_a_picture_shows_the_object_and_the_fingertips_in_their_colours(pictures):
    for picture in pictures.reshape(6, 64, 80, 3):
        hue = hues(picture)
        # Orange object, teal fingertips, hue in 256 steps.
        assert np.sum((hue > 8) & (hue < 30)) > 60
        assert np.sum((hue > 115) & (hue < 135)) > 5


def test_a_grasp_looks_the_same_whatever_grasps_are_drawn_with_it(block, pictures):
    alone = grasp_pictures(HAND, block, POSES[1:], JOINTS[1:], (80, 64), THREE_SIDES, samples=4)
    np.testing.assert_array_equal(alone[0], pictures[1])


def test_no_grasps_give_no_pictures(block):
    drawn = grasp_pictures(HAND, block, np.zeros((0, 7)), np.zeros((0, 2)), (80, 64), THREE_SIDES)
    assert drawn.shape == (0, 3, 64, 80, 3)


def quality(count: int) -> dict[str, np.ndarray]:
    epsilon = np.arange(count, dtype=float)[:, None] * np.array([1.0, 10.0])
    return {
        "quality/thresholds_m": np.array([0.001, 0.005]),
        "quality/epsilon": epsilon,
        "quality/contact_area_cm2": epsilon,
        "quality/penetration_depth_mm": np.full(count, 0.25),
    }


def test_the_best_grasps_are_those_with_the_largest_epsilon_among_the_chosen():
    chosen = np.array([True, True, True, True, False])
    assert best(quality(5), 3, chosen).tolist() == [3, 2, 1]
    assert best(quality(5), 9, chosen).tolist() == [3, 2, 1, 0]


def test_captions_quote_the_metrics_at_five_millimetres():
    assert figures(quality(5), np.array([3])) == [
        [("epsilon", "30.000"), ("contact", "30.0 cm^2"), ("depth", "0.25 mm")]
    ]


def opened(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def test_a_contact_sheet_holds_every_picture_unchanged(pictures):
    sheet = opened(contact_sheet(pictures[:, 0], title="block", columns=2))
    for picture in pictures[:, 0]:
        windows = np.lib.stride_tricks.sliding_window_view(sheet[..., 0], (4, 80))
        assert (windows == picture[30:34, :, 0]).all(axis=(2, 3)).any()
    assert tuple(sheet[0, 0]) == PAPER


def test_a_three_sides_sheet_is_wide_enough_for_three(pictures):
    sheet = opened(three_sides_sheet(pictures, title="block", columns=1))
    assert sheet.shape[1] >= 3 * 80


@pytest.mark.parametrize(("stereo", "cells"), [(True, 5), (False, 4)])
def test_a_views_page_has_a_row_per_placement(block, stereo, cells):
    pose = np.array([[0, 0, 0.03, 1.0, 0, 0, 0]])
    views = render(block, pose, views=2, stereo=stereo, width=64, height=48, seed=0, samples=2)
    page = opened(views_page(views, title="block"))
    assert page.shape[1] > cells * 64
    assert page.shape[0] > 2 * 48


def test_a_views_page_shows_the_pictures_with_a_hand_where_there_are_any(block):
    pose = np.array([[0, 0, 0.03, 1.0, 0, 0, 0]])
    views = render(block, pose, views=1, stereo=False, width=64, height=48, seed=0, samples=2)
    without = opened(views_page(views, title="block"))
    views["image/rgb_hand"] = np.full((1, 48, 64, 3), [255, 0, 255], np.uint8)
    page = opened(views_page(views, title="block"))
    assert page.shape[1] == without.shape[1] + 64 + GAP
    shown = (page == [255, 0, 255]).all(axis=-1)
    assert shown.sum() == 48 * 64 and not shown[:, : without.shape[1] - MARGIN].any()


def test_depth_colours_darken_with_distance_and_grey_is_nothing():
    colours = depth_colours(np.array([0.2, 0.3, 0.4, 0.5, np.inf], np.float32), 0.2, 0.5).astype(int)
    lightness = colours[:4] @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(lightness) < -20)
    assert colours[4].tolist() == [214, 214, 214]
