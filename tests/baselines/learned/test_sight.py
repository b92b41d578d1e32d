"""The cloud that a network is shown of an object is what a camera sees of it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd.baselines.learned.method import ELEVATION, NEAREST_M, SurfaceView
from graspd.service.model.transforms import apply, quat_from_axis_angle
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path

POSE = np.concatenate([[0.2, -0.1, 0.05], quat_from_axis_angle(np.array([0.0, 0, 1]), np.asarray(0.7))])


@pytest.fixture(scope="module")
def mug() -> ObjectModel:
    return object_from_path("mug")


def test_points_lie_on_the_surface_look_at_the_camera_and_nothing_is_before_them(mug: ObjectModel) -> None:
    seen, rng = SurfaceView.of(mug), np.random.default_rng(3)
    mesh = trimesh.Trimesh(apply(POSE, mug.vertices), mug.faces, process=False)
    for _ in range(3):
        camera = seen.camera(POSE, rng)
        points, normals = seen.cloud(POSE, camera, 400, rng)
        assert points.shape == normals.shape == (400, 3)
        rays = points - camera
        assert ((rays * normals).sum(axis=1) < 0).all()
        far = np.linalg.norm(rays, axis=1)
        # The exact first hit of the ray through each point.
        where, ray, _ = mesh.ray.intersects_location(np.tile(camera, (400, 1)), rays, multiple_hits=False)
        gap = far[ray] - np.linalg.norm(where - camera, axis=1)
        assert len(set(ray.tolist())) >= 396  # a ray along an edge may miss
        # A pixel whose front no sample fell into shows what is behind: inside of the mug, the wall behind the handle.
        assert (np.abs(gap) < 1e-3).mean() > 0.97


def test_cameras_stand_where_pictures_have_them(mug: ObjectModel) -> None:
    seen, rng = SurfaceView.of(mug), np.random.default_rng(0)
    middle = apply(POSE, mug.centre_of_mass)
    out = np.array([seen.camera(POSE, rng) - middle for _ in range(200)])
    distance = np.linalg.norm(out, axis=1)
    elevation = np.arcsin(out[:, 2] / distance)
    assert (elevation >= ELEVATION[0] - 1e-9).all() and (elevation <= ELEVATION[1] + 1e-9).all()
    assert (distance >= NEAREST_M + mug.radius - 1e-9).all() and (distance < 0.8).all()
    assert np.linalg.norm((out[:, :2] / distance[:, None]).mean(axis=0)) < 0.15  # from all sides


def test_few_pixels_still_fill_a_cloud(mug: ObjectModel) -> None:
    seen = SurfaceView.of(mug)
    rng = np.random.default_rng(0)
    points, _ = seen.cloud(POSE, seen.camera(POSE, rng), 8192, rng)
    assert points.shape == (8192, 3) and np.isfinite(points).all()
