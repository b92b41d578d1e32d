"""Cameras: frames, pairs, where sampled ones stand."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.pinhole import pixel_rays
from graspd.worker.rendering.cameras import (
    ELEVATION,
    FIELD_OF_VIEW,
    NEAREST_M,
    Cameras,
    intrinsics,
    look_at,
    sample_hemisphere,
    stereo_pair,
)

CENTRE, RADIUS = np.array([0.05, -0.02, 0.04]), 0.07


def sampled(seed: int, views: int = 12) -> Cameras:
    rng = np.random.default_rng(seed)
    extrinsics = sample_hemisphere(CENTRE, RADIUS, views=views, field_of_view=FIELD_OF_VIEW, rng=rng)
    return Cameras(320, 240, intrinsics(320, 240), np.stack(extrinsics))


def test_a_camera_looks_at_its_target_with_the_table_upright():
    matrix = look_at(np.array([0.3, 0.2, 0.4]), CENTRE)
    camera = Cameras(320, 240, intrinsics(320, 240), matrix[None])
    pixels, depth = camera.project(CENTRE + np.array([[0, 0, 0], [0, 0, 0.05]]))
    np.testing.assert_allclose(pixels[0, 0], [160, 120], atol=1e-9)
    assert depth[0, 0] == pytest.approx(np.linalg.norm(CENTRE - [0.3, 0.2, 0.4]))
    assert pixels[0, 1, 0] == pytest.approx(160, abs=1e-9)
    assert pixels[0, 1, 1] < 120


@pytest.mark.parametrize("eye", [(0.0, 0.0, 0.5), (0.3, -0.2, 0.1)])
def test_extrinsics_are_rigid_and_right_handed(eye):
    rotation = look_at(np.array(eye), np.zeros(3))[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_the_field_of_view_spans_the_height():
    k = intrinsics(320, 240)
    assert 2 * np.arctan(120 / k[1, 1]) == pytest.approx(FIELD_OF_VIEW)
    top = pixel_rays(k, 320, 240)[0, 0]
    np.testing.assert_allclose(top, [-159.5 / k[0, 0], -119.5 / k[1, 1], 1.0])


def test_the_right_eye_stands_a_baseline_along_the_cameras_x():
    middle = look_at(np.array([0.3, 0.2, 0.4]), CENTRE)
    pair = Cameras(320, 240, intrinsics(320, 240), np.stack(stereo_pair(middle, 0.06)))
    np.testing.assert_allclose(pair.centre[1] - pair.centre[0], 0.06 * middle[0, :3], atol=1e-12)
    np.testing.assert_array_equal(pair.extrinsics[0, :3, :3], pair.extrinsics[1, :3, :3])


def test_unprojecting_what_was_projected_gives_the_point_back():
    camera = sampled(0, views=3)
    depth = np.random.default_rng(0).uniform(0.2, 0.6, (3, 240, 320))
    points = camera.unproject(depth).reshape(3, -1, 3)
    pixels, back = camera.project(points)
    np.testing.assert_allclose(back.reshape(depth.shape), depth, atol=1e-12)
    np.testing.assert_allclose(pixels[1].reshape(240, 320, 2)[5, 7], [7.5, 5.5], atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_sampled_cameras_stand_on_the_hemisphere_and_see_the_whole_object(seed):
    camera = sampled(seed)
    away = camera.centre - CENTRE
    distance = np.linalg.norm(away, axis=1)
    elevation = np.arcsin(away[:, 2] / distance)
    assert np.all((elevation > ELEVATION[0] - 1e-9) & (elevation < ELEVATION[1] + 1e-9))
    assert np.all(distance >= NEAREST_M + RADIUS - 1e-12)
    directions = np.random.default_rng(seed).normal(size=(200, 3))
    ball = CENTRE + RADIUS * 0.8 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    pixels, _ = camera.project(ball)
    assert np.all((pixels > 0) & (pixels < [320, 240]))


def test_sampled_azimuths_go_all_the_way_round():
    away = sampled(5).centre - CENTRE
    azimuth = np.sort(np.arctan2(away[:, 1], away[:, 0]))
    gaps = np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi))
    # One camera per twelfth, jittered by 0.8 of it.
    assert gaps.max() < 1.8 * 2 * np.pi / 12 + 1e-9
