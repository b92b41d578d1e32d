"""Surfaces that pass through themselves: found, and counted once where that is safe."""

from __future__ import annotations

import numpy as np
import pytest
from manifold3d import Manifold
from numpy.typing import NDArray

from graspd.worker.objects.check import check_object
from graspd.worker.objects.intersections import crossings, untangle
from graspd.worker.objects.mesh_geometry import from_manifold, signed_volume
from tests.worker.objects.shapes import Mesh, box, cylinder, join, sphere, stl

RADIUS = 0.008
#: Where two cylinders of one radius cross at right angles they share 16/3 r^3 (Steinmetz).
SHARED = 16 / 3 * RADIUS**3
#: A circle of 24 corners has 1.1 % less area; bent along a curve the tube is no exact cylinder where it crosses itself.
ROUGHLY = 0.04


def crossing_tube(scale: float = 0.04, inside_out: bool = False) -> Mesh:
    """One closed tube along (u^2 - 1, u^3 - u), a curve that crosses itself at right angles at the origin."""

    def bend(point: tuple[float, float, float]) -> tuple[float, float, float]:
        u = 3.0 * (point[2] - 0.5)
        way = np.array([2 * u, 3 * u * u - 1, 0.0])
        way /= np.linalg.norm(way)
        side = np.array([-way[1], way[0], 0.0])
        centre = scale * np.array([u * u - 1, u * (u * u - 1), 0.0])
        x, y, z = centre + point[0] * side + np.array([0.0, 0.0, point[1]])
        return (x, y, z)

    tube = Manifold.cylinder(1.0, RADIUS, RADIUS, 24).refine_to_length(0.05).warp(bend)
    vertices, faces = from_manifold(tube)
    return (vertices, faces[:, ::-1]) if inside_out else (vertices, faces)


def everted_dumbbell() -> Mesh:
    """A box of whose corners two changed places: part of it is turned inside out."""
    vertices, faces = from_manifold(Manifold.cube((0.06, 0.05, 0.04), True).refine(6))
    twist: NDArray[np.float64] = vertices.copy()
    twist[:, :2] *= -np.sign(vertices[:, 2:]) * (np.abs(vertices[:, 2:]) > 0.01) + (np.abs(vertices[:, 2:]) <= 0.01)
    twist[vertices[:, 2] > 0, 2] *= -0.5
    return twist, faces


@pytest.mark.parametrize("mesh", [box(), sphere(), cylinder(), join(box(), box(at=(0.2, 0.0, 0.0)))])
def test_a_sound_surface_passes_through_itself_nowhere(mesh: Mesh) -> None:
    found = crossings(*mesh)
    assert found is not None and not len(found)


def test_faces_that_pass_through_each_other_are_found() -> None:
    large, small = box(0.06, 0.06, 0.06), box(0.02, 0.02, 0.02, at=(0.03, 0.002, 0.001))
    found = crossings(*join(large, small))
    assert found is not None and len(found)
    assert (found[:, 0] < len(large[1])).all() and (found[:, 1] >= len(large[1])).all()


def test_faces_that_only_touch_do_not_count() -> None:
    found = crossings(*join(box(0.04, 0.04, 0.04), box(0.02, 0.02, 0.02, at=(0.03, 0.0, 0.0))))
    assert found is not None and not len(found)


def test_what_a_tube_encloses_twice_counts_once() -> None:
    tube = crossing_tube()
    united = untangle(*tube)
    assert united is not None
    assert signed_volume(*tube) - signed_volume(*united) == pytest.approx(SHARED, rel=ROUGHLY)
    left = crossings(*united)
    assert left is not None and not len(left)


@pytest.mark.parametrize("inside_out", [False, True])
def test_a_tube_through_itself_is_repaired_and_said_so(inside_out: bool) -> None:
    report = check_object(stl(crossing_tube(inside_out=inside_out)), "tube")
    assert report["verdict"] == "repair"
    assert any("intersect" in repair for repair in report["repairs"])
    assert report["facts"]["self_intersections"] == 0
    # The surface that is left was there before.
    assert report["facts"]["repair_deviation_m"] < 1e-6


def test_what_cannot_be_repaired_safely_is_left_and_said() -> None:
    twisted = everted_dumbbell()
    assert untangle(*twisted) is None
