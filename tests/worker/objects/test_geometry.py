"""Mass, normals, distances and simplification against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graspd.worker.objects.distance import MeshDistance, deviation, point_triangle_distance, sample_faces
from graspd.worker.objects.mesh_geometry import corner_normals, mass_properties, signed_volume
from graspd.worker.objects.prepare import load_object, object_from_path, simplify
from graspd.worker.objects.topology import components, is_closed
from tests.worker.objects.shapes import box, cylinder, sphere, stl


def test_mass_properties_of_a_box_are_exact_far_from_the_origin() -> None:
    x, y, z = 0.06, 0.05, 0.04
    at = np.array([3.0, -2.0, 1.0])
    vertices, faces = box(x, y, z, at=tuple(at))
    mass = mass_properties(vertices, faces)
    assert mass.volume == pytest.approx(x * y * z, rel=1e-12)
    np.testing.assert_allclose(mass.centre_of_mass, at, atol=1e-12)
    np.testing.assert_allclose(mass.inertia, np.diag([y * y + z * z, z * z + x * x, x * x + y * y]) / 12, atol=1e-12)


def test_inertia_turns_with_the_body() -> None:
    vertices, faces = box()
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    expected = turn @ mass_properties(vertices, faces).inertia @ turn.T
    np.testing.assert_allclose(mass_properties(vertices @ turn.T, faces).inertia, expected, atol=1e-14)


def test_mass_properties_of_a_sphere_converge_to_the_ball() -> None:
    vertices, faces = sphere(0.04, 256)
    mass = mass_properties(vertices, faces)
    # An inscribed sphere of 256 segments is short of the ball by (pi / 256)^2 in volume, to a small factor.
    assert mass.volume == pytest.approx(4 / 3 * np.pi * 0.04**3, rel=1e-3)
    np.testing.assert_allclose(mass.inertia, 0.4 * 0.04**2 * np.eye(3), rtol=2e-3, atol=1e-9)


def test_corner_normals_of_a_box_stay_on_their_faces() -> None:
    vertices, faces = box()
    normals = corner_normals(vertices, faces.astype(np.int32))
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    face = np.cross(b - a, c - a)
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    np.testing.assert_allclose(normals, np.repeat(face[:, None], 3, axis=1), atol=1e-12)


def test_corner_normals_of_a_cylinder_are_radial_on_the_wall_and_flat_on_the_lids() -> None:
    vertices, faces = cylinder()
    normals = corner_normals(vertices, faces.astype(np.int32))
    corners = vertices[faces]
    wall = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]) < 1e-12
    np.testing.assert_allclose(np.abs(normals[~wall][:, :, 2]), 1.0, atol=1e-12)
    radial = corners[wall] * [1, 1, 0]
    radial /= np.linalg.norm(radial, axis=2, keepdims=True)
    # Three faces of a quad strip meet at a wall corner with unequal angles: half a segment's angle at most.
    assert np.einsum("ijk,ijk->ij", normals[wall], radial).min() > np.cos(np.pi / 48)


def test_corner_normals_of_a_sphere_are_those_of_the_ball() -> None:
    vertices, faces = sphere(0.04, 128)
    normals = corner_normals(vertices, faces.astype(np.int32))
    exact = vertices[faces] / np.linalg.norm(vertices[faces], axis=2, keepdims=True)
    assert np.einsum("ijk,ijk->ij", normals, exact).min() > np.cos(np.deg2rad(2))


def test_point_triangle_distance_is_the_minimum_over_a_fine_grid() -> None:
    rng = np.random.default_rng(5)
    triangles, points = rng.random((40, 3, 3)), 2 * rng.random((40, 3)) - 0.5
    steps = 120
    grid = np.array([(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]) / steps
    inside = np.einsum("gk,tkd->tgd", grid, triangles)
    brute = np.linalg.norm(inside - points[:, None], axis=2).min(axis=1)
    exact = point_triangle_distance(points, triangles)
    # A grid of 1/120 misses the foot by at most a cell of 1.7 / 120.
    assert (exact <= brute + 1e-12).all() and (brute - exact).max() < 0.015


def test_mesh_distance_equals_the_minimum_over_all_triangles(shared_data: Path) -> None:
    path = shared_data / "objects" / "024_bowl" / "clean.stl"
    model = object_from_path(path, 0.0)
    faces = model.faces.astype(np.int64)
    points = sample_faces(model.vertices, faces, 60)[0] + np.random.default_rng(0).normal(scale=0.01, size=(60, 3))
    brute = point_triangle_distance(points[:, None], model.vertices[faces][None]).min(axis=1)
    np.testing.assert_allclose(MeshDistance(model.vertices, faces)(points), brute, atol=1e-12)


def test_deviation_of_two_concentric_spheres_is_the_difference_of_their_radii() -> None:
    # Chords of 128 segments lie up to r (pi / 128)^2 / 2 = 0.012 mm inside.
    assert deviation(sphere(0.04, 128), sphere(0.041, 128)) == pytest.approx(1e-3, abs=3e-5)


@pytest.mark.parametrize("error", [1e-4, 3e-4, 1e-3])
@pytest.mark.parametrize("name", ["mug", "bottle"])
def test_simplification_keeps_its_bound_and_the_mesh_closed(name: str, error: float) -> None:
    whole, model = object_from_path(name, 0.0), object_from_path(name, error)
    before = (whole.vertices, whole.faces.astype(np.int64))
    after = (model.vertices, model.faces.astype(np.int64))
    assert len(after[1]) < 0.8 * len(before[1])
    assert is_closed(after[1]) and signed_volume(*after) > 0 and components(after[1]).max() == 0
    # Measured again with other, more points: a maximum over points may lie a little above the one that was bounded.
    assert deviation(before, after, samples=20_000) <= 1.05 * error
    assert model.deviation_m <= error


def test_a_tighter_bound_never_gives_fewer_faces() -> None:
    counts = [len(object_from_path("bottle", error).faces) for error in (1e-4, 3e-4, 1e-3)]
    assert counts == sorted(counts, reverse=True)


def test_an_error_of_zero_leaves_the_mesh_as_it_is() -> None:
    vertices, faces = sphere(segments=128)
    same = simplify(vertices, faces, 0.0)
    assert same[0] is vertices and same[1] is faces and same[2] == 0.0


def test_a_flat_face_collapses_to_few_triangles() -> None:
    from manifold3d import Manifold

    from graspd.worker.objects.mesh_geometry import from_manifold

    vertices, faces = from_manifold(Manifold.cube((0.06, 0.05, 0.04), True).refine_to_length(0.002))
    assert len(faces) > 5000
    assert len(simplify(vertices, faces, 1e-5)[1]) < 100


def test_the_model_of_a_box_has_its_hull_and_radius() -> None:
    model = load_object(stl(box()), name="b", digest="d", face_error_m=3e-4)
    assert model.name == "b" and model.digest == "d"
    assert len(model.hull_vertices) == 8 and len(model.hull_faces) == 12
    assert model.radius == pytest.approx(np.linalg.norm([0.03, 0.025, 0.02]), rel=1e-6)
    assert signed_volume(model.hull_vertices, model.hull_faces) == pytest.approx(model.volume, rel=1e-6)
