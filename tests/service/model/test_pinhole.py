"""From pixels to points and normals, against closed forms."""

import numpy as np
import pytest

from graspd.service.model.pinhole import back_project, fitted_normals, pixel_rays, surface_normals

K = np.array([[90.0, 0, 31.5], [0, 80.0, 24.5], [0, 0, 1]])
WIDTH, HEIGHT = 64, 48


def plane_depth(normal: np.ndarray, offset: float) -> np.ndarray:
    return offset / (pixel_rays(K, WIDTH, HEIGHT) @ normal)


@pytest.mark.parametrize("normal", [[0, 0, -1.0], [0.5, 0.1, -0.9], [-0.2, 0.7, -0.6]])
def test_points_lie_on_the_plane_and_have_its_normal(normal: list[float]) -> None:
    unit = np.array(normal) / np.linalg.norm(normal)
    points = back_project(K, plane_depth(unit, -0.5))
    np.testing.assert_allclose(points @ unit, -0.5, atol=1e-12)  # rounding of float64
    np.testing.assert_allclose(surface_normals(points), np.broadcast_to(unit, points.shape), atol=1e-9)
    np.testing.assert_allclose(K @ points[3, 5] / points[3, 5, 2], [5.5, 3.5, 1], atol=1e-12)


def test_a_normal_does_not_bridge_two_surfaces() -> None:
    near, far = np.array([0.3, 0, -0.9]), np.array([-0.3, 0.2, -0.9])
    depth = np.where(np.arange(WIDTH) < 30, plane_depth(near, -0.4), plane_depth(far, -0.7))
    found = surface_normals(back_project(K, depth))
    for columns, normal in ((slice(None, 30), near), (slice(30, None), far)):
        expected = np.broadcast_to(normal / np.linalg.norm(normal), found[:, columns].shape)
        np.testing.assert_allclose(found[:, columns], expected, atol=1e-9)


def test_a_fitted_normal_is_the_planes_beside_edges_and_rims() -> None:
    left, right = np.array([0.6, 0, -0.8]), np.array([0.0, 0.6, -0.8])
    depth = np.where(np.arange(WIDTH) < 30, plane_depth(left, -0.3), plane_depth(right, -0.6))
    points = back_project(K, depth)
    row, column = np.array([0, 20, 20, 47]), np.array([0, 29, 30, 63])
    found = fitted_normals(points, row, column, radius=2, gap_m=np.full(4, 0.03))
    np.testing.assert_allclose(found, [left, left, right, right], atol=1e-6)


def test_a_point_alone_has_no_normal_of_its_own_and_looks_at_the_camera() -> None:
    depth = np.full((HEIGHT, WIDTH), np.inf)
    depth[20, 40] = 0.7
    points = back_project(K, depth)
    assert np.isfinite(points[..., 2]).sum() == 1 and np.isnan(surface_normals(points)).all()
    found = fitted_normals(points, np.array([20]), np.array([40]), radius=3, gap_m=np.array([0.1]))[0]
    np.testing.assert_allclose(found, -points[20, 40] / np.linalg.norm(points[20, 40]), atol=1e-12)
