"""Polygons become triangles that lie inside them, whatever their shape and the format that has them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from graspd.service.model.errors import LimitError
from graspd.worker.objects.formats import read_mesh
from graspd.worker.objects.formats.soup import triangulate

#: A channel, open above: its ends are polygons with two re-entrant corners.
U = np.array([(0, 0), (80, 0), (80, 50), (70, 50), (70, 10), (10, 10), (10, 50), (0, 50)], float) / 1000
LENGTH = 0.06


def channel() -> tuple[np.ndarray, list[list[int]]]:
    n = len(U)
    points = np.vstack([np.column_stack([U[:, 0], np.full(n, y), U[:, 1]]) for y in (0.0, LENGTH)])
    sides = [[k + n, (k + 1) % n + n, (k + 1) % n, k] for k in range(n)]
    return points, [list(range(n)), list(range(2 * n - 1, n - 1, -1)), *sides]


def text(name: str) -> bytes:
    points, faces = channel()
    rows = [" ".join(map(str, point)) for point in points]
    if name.endswith(".obj"):
        lines = [f"v {row}" for row in rows] + ["f " + " ".join(str(k + 1) for k in face) for face in faces]
    else:
        polygons = [f"{len(face)} " + " ".join(map(str, face)) for face in faces]
        head = ["OFF", f"{len(points)} {len(faces)} 0"]
        if name.endswith(".ply"):
            head = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
            head += [f"property double {axis}" for axis in "xyz"]
            head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
        lines = [*head, *rows, *polygons]
    return "\n".join(lines).encode()


@pytest.mark.parametrize("name", ["u.obj", "u.off", "u.ply"])
def test_a_channel_of_re_entrant_polygons_is_as_large_as_it_is(name: str) -> None:
    soup = read_mesh(name, text(name))
    mesh = trimesh.Trimesh(soup.vertices, soup.faces)
    ends = 2 * (0.08 * 0.05 - 0.06 * 0.04)
    around = 2 * (0.08 + 0.05 + 0.04) * LENGTH
    assert mesh.is_watertight and mesh.area == pytest.approx(ends + around)
    assert abs(mesh.volume) == pytest.approx(ends / 2 * LENGTH)


@given(st.integers(3, 40), st.integers(0, 10**6))
def test_a_star_is_cut_into_triangles_of_its_area(corners: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    angle = np.sort(random.uniform(0, 2 * np.pi, corners))
    flat = (random.uniform(0.2, 1.0, corners) * np.exp(1j * angle)).view(float).reshape(-1, 2)
    # Stars around a point in which an angle gap of half a turn or more would leave them are no simple polygons.
    if np.diff(angle, append=angle[0] + 2 * np.pi).max() >= np.pi:
        return
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    points = np.column_stack([flat, np.zeros(corners)]) @ turn.T
    triangles = triangulate(points, np.array([corners]), np.arange(corners))
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    vectors = np.cross(b - a, c - a) / 2
    x, y = flat.T
    area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    # Triangles that overlap or lie outside would add up to more than their vector sum.
    assert len(triangles) == corners - 2
    assert np.linalg.norm(vectors, axis=1).sum() == pytest.approx(area, rel=1e-9)


def test_convex_polygons_are_fans_from_their_first_corner() -> None:
    angle = np.linspace(0, 2 * np.pi, 7)[:-1]
    points = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    found = triangulate(points, np.array([6]), np.arange(6))
    assert found.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]


def test_corners_on_a_line_stay_corners_so_that_neighbours_fit() -> None:
    flat = [(0, 0), (4, 0), (4, 4), (3, 4), (3, 1), (2, 1), (1, 1), (1, 4), (0, 4)]
    points = np.column_stack([np.array(flat, float), np.zeros(9)])
    found = triangulate(points, np.array([9]), np.arange(9))
    assert set(found.ravel().tolist()) == set(range(9)) and len(found) == 7


def test_re_entrant_polygons_of_very_many_corners_are_refused() -> None:
    count = 40_000
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    points = (
        np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) * np.where(np.arange(count) % 2, 1, 0.5)[:, None]
    )
    with pytest.raises(LimitError, match="triangulate"):
        triangulate(points, np.array([count]), np.arange(count))
