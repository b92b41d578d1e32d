"""Distances and normals of the object's surface against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
import warp as wp

from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation import kernels
from graspd.worker.simulation.device import DeviceObject
from graspd.worker.simulation.kernels import surface
from graspd.worker.simulation.sampling import object_samples
from tests.worker.simulation.rigs import ball, object_of

#: float32 coordinates of size 0.1 m.
FLOAT32 = 2e-8


def probe(
    obj: ObjectModel, points: np.ndarray, *, alpha: float, cell: float = 0.0, exact_below: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    kernels.load("cpu")
    device = DeviceObject.create(obj, "cpu", samples=object_samples(obj, 50), phong_alpha=alpha, cell=cell)
    with wp.ScopedDevice("cpu"):
        distance, normal = wp.zeros(len(points)), wp.zeros(len(points), dtype=wp.vec3)
        at = wp.array(points - obj.centre_of_mass, dtype=wp.vec3)
        wp.launch(surface.probe, len(points), inputs=[device.surface, at, 0.2, exact_below], outputs=[distance, normal])
        return distance.numpy().astype(float), normal.numpy().astype(float)


def around(rng: np.random.Generator, radius: float, gap: float, count: int = 400) -> np.ndarray:
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * (radius + rng.uniform(-gap, gap, (count, 1)))


def test_flat_distance_to_a_box_is_exact() -> None:
    half = np.array([0.03, 0.02, 0.04])
    box = object_of(trimesh.creation.box(2 * half))
    points = np.random.default_rng(0).uniform(-0.06, 0.06, (500, 3))
    a = np.abs(points) - half
    expected = np.linalg.norm(np.maximum(a, 0), axis=1) + np.minimum(a.max(axis=1), 0)
    found, _ = probe(box, points, alpha=0.0)
    np.testing.assert_allclose(found, expected, atol=FLOAT32)


def test_phong_leaves_flat_faces_and_sharp_edges_alone() -> None:
    box = object_of(trimesh.creation.box((0.06, 0.04, 0.08)))
    points = np.random.default_rng(1).uniform(-0.06, 0.06, (500, 3))
    np.testing.assert_allclose(probe(box, points, alpha=0.5)[0], probe(box, points, alpha=0.0)[0], atol=FLOAT32)


def test_phong_brings_a_coarse_ball_closer_to_the_sphere() -> None:
    radius = 0.035
    coarse = ball(radius, subdivisions=2)
    points = around(np.random.default_rng(2), radius, 0.004)
    expected = np.linalg.norm(points, axis=1) - radius
    flat = np.abs(probe(coarse, points, alpha=0.0)[0] - expected).mean()
    smooth = np.abs(probe(coarse, points, alpha=0.5)[0] - expected).mean()
    assert smooth < flat / 5


def test_the_smoothed_distance_is_continuous_across_the_surface() -> None:
    """Along rays steps of 10 um never change the distance by more than 12 um within 1 mm of the surface."""
    radius, coarse = 0.035, ball(0.035, subdivisions=2)
    direction = around(np.random.default_rng(3), 1.0, 0.0, 50)
    steps = np.arange(radius - 0.008, radius + 0.004, 1e-5)
    points = (direction[:, None] * steps[None, :, None]).reshape(-1, 3)
    found = probe(coarse, points, alpha=0.5)[0].reshape(50, -1)
    near = np.abs(found[:, :-1]) < 1e-3
    assert near.any(axis=1).all()
    assert np.abs(np.diff(found, axis=1))[near].max() < 1.2e-5


def test_normals_of_a_fine_ball_point_outward_on_both_sides_and_on_the_surface() -> None:
    obj = ball(0.035, subdivisions=4)
    rng = np.random.default_rng(4)
    points = np.concatenate([around(rng, 0.035, 0.003), obj.vertices[:20]])
    _, normals = probe(obj, points, alpha=0.5)
    radial = points / np.linalg.norm(points, axis=1, keepdims=True)
    # Faces of 2 mm on a ball of 35 mm turn by 0.06 rad from one to the next.
    assert (normals * radial).sum(axis=1).min() > np.cos(0.06)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("alpha", [0.0, 0.5])
def test_the_normal_is_the_gradient_of_the_distance_away_from_the_surface(alpha: float) -> None:
    obj = ball(0.035, subdivisions=4)
    points = around(np.random.default_rng(5), 0.05, 0.01, 100)
    _, normals = probe(obj, points, alpha=alpha)
    step = 1e-4
    numeric = np.stack(
        [
            (probe(obj, points + step * e, alpha=alpha)[0] - probe(obj, points - step * e, alpha=alpha)[0]) / (2 * step)
            for e in np.eye(3)
        ],
        axis=1,
    )
    cosine = (numeric * normals).sum(axis=1) / np.linalg.norm(numeric, axis=1)
    assert np.median(cosine) > 0.9995 and cosine.min() > 0.99


def test_the_grid_agrees_with_the_mesh_where_it_is_used() -> None:
    obj = ball(0.035)
    points = around(np.random.default_rng(6), 0.05, 0.012)
    grid = probe(obj, points, alpha=0.5, cell=0.005, exact_below=0.0)[0]
    exact = probe(obj, points, alpha=0.5)[0]
    # Trilinear interpolation of a distance with curvature 1/r on cells h: h^2 / (4 r) at r = 38 mm.
    np.testing.assert_allclose(grid, exact, atol=2.5e-4)


def test_distances_below_the_threshold_never_come_from_the_grid() -> None:
    obj = ball(0.035)
    points = around(np.random.default_rng(7), 0.035, 0.004)
    mixed = probe(obj, points, alpha=0.5, cell=0.005, exact_below=0.004)[0]
    np.testing.assert_allclose(mixed, probe(obj, points, alpha=0.5)[0], atol=FLOAT32)


def test_a_thin_plate_has_an_inside_and_two_outsides() -> None:
    plate = object_of(trimesh.creation.box((0.1, 0.08, 0.001)))
    z = np.array([-0.002, -0.0004, 0.0, 0.0004, 0.002])
    found = probe(plate, np.column_stack([np.full((5, 2), 0.01), z]), alpha=0.5)[0]
    np.testing.assert_allclose(found, np.abs(z) - 0.0005, atol=FLOAT32)


def test_points_far_away_on_edges_and_on_vertices_give_finite_results() -> None:
    box = object_of(trimesh.creation.box((0.06, 0.04, 0.08)))
    corner = np.array([0.03, 0.02, 0.04])
    points = np.array([corner, corner * [1, 1, 0], [0, 0, 0], [5.0, 5, 5], corner + 1e-9])
    distance, normal = probe(box, points, alpha=0.5, cell=0.005, exact_below=0.004)
    assert np.all(np.isfinite(distance)) and np.all(np.isfinite(normal))
