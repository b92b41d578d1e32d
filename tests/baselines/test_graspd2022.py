"""Grasp'D (2022): its distance grid, its contact forces, and what its relaxation relaxes."""

from functools import cache

import numpy as np
import pytest
import trimesh
import warp as wp

from graspd.baselines.common import load_pair
from graspd.baselines.graspd2022 import kernels, method
from graspd.baselines.graspd2022.method import Search, _Batch, distance_grid, force_model
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.kernels.surface import Surface, field_distance
from tests.worker.models import object_from_mesh, two_finger_hand, unit_vectors

RADIUS = 0.05
SPHERE = object_from_mesh(trimesh.creation.icosphere(subdivisions=4, radius=RADIUS))
BOX = object_from_mesh(trimesh.creation.box((0.05, 0.05, 0.05)))
CELLS = 48
#: Farthest that the sphere's flat faces lie inside the sphere [m].
SAGITTA = RADIUS - float(np.linalg.norm(SPHERE.vertices[SPHERE.faces].mean(axis=1), axis=1).min())


@cache
def grid_of_sphere(cells: int):
    return distance_grid(load_pair(two_finger_hand(), SPHERE, "cpu", kernels).fine.obj, cells)


@wp.kernel(enable_backward=False)
def _probe(
    physics: kernels.ForceModel, surface: Surface, points: wp.array[wp.vec3], speed: wp.vec3, out: wp.array2d[wp.vec3]
):
    i = wp.tid()
    sample = field_distance(surface, points[i])
    out[0, i] = wp.vec3(sample.distance)
    out[1, i] = kernels.contact_force(physics, -sample.distance, sample.normal, speed)
    out[2, i] = kernels.force_slope(physics, -sample.distance, sample.normal, speed)


def probed(points: np.ndarray, velocity: tuple[float, ...] = (0, 0, 0), grid=None) -> tuple[np.ndarray, ...]:
    """Distance, force and slope at points by a grid, by default of the sphere."""
    found = wp.zeros((3, len(points)), dtype=wp.vec3, device="cpu")
    at = wp.array(points, dtype=wp.vec3, device="cpu")
    given = [force_model(SPHERE.gyration_radius), grid or grid_of_sphere(CELLS), at, wp.vec3(*velocity)]
    wp.launch(_probe, len(points), inputs=given, outputs=[found], device="cpu")
    distance, force, slope = found.numpy()
    return distance[:, 0], force, slope


@pytest.mark.parametrize("cells", [16, 32, 48])
def test_grid_tells_spheres_distance_with_error_of_second_order(cells: int) -> None:
    """Trilinear interpolation of |x| - R is off by at most 3/8 h^2 max |d''|, and |d''| <= 2 / |x| in the cell."""
    rng = np.random.default_rng(3)
    direction, reach = unit_vectors(rng, 2000), rng.uniform(0.03, 0.12, size=2000)
    points = direction * reach[:, None]
    cell = 2 * (RADIUS + 0.10) / cells
    error = np.abs(probed(points, grid=grid_of_sphere(cells))[0] - (reach - RADIUS))
    bound = 0.375 * 2 * cell**2 / np.maximum(reach - np.sqrt(3) * cell, 0.005)
    assert np.all(error <= bound + SAGITTA + 1e-6)


def ring(depth: float) -> np.ndarray:
    return (RADIUS - depth) * np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]])


def test_points_inside_push_the_object_away_and_rub_against_it() -> None:
    box = distance_grid(load_pair(two_finger_hand(), BOX, "cpu", kernels).fine.obj, CELLS)
    faces = 0.024 * np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]])
    distance, force, _ = probed(faces, (0.0, 0.0, 0.01), box)
    depth = -distance
    np.testing.assert_allclose(depth, 0.001, rtol=1e-3)
    # At the two points whose normal is across the motion: k c inwards, and the lesser of kf v and mu k c against it.
    rub = np.minimum(method.VISCOUS * 0.01, method.FRICTION * method.STIFFNESS * depth)
    np.testing.assert_allclose(force[:2, 2], -rub[:2], rtol=1e-3)
    np.testing.assert_allclose([-force[0, 0], -force[1, 1]], method.STIFFNESS * depth[:2], rtol=1e-3)
    # Where the motion is along the normal there is no friction.
    np.testing.assert_allclose(force[2], [0, 0, method.STIFFNESS * depth[2]], atol=0.1)


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.01), (0.005, 0.01, -0.01)])
def test_the_slope_of_the_force_is_its_difference_quotient(velocity: tuple[float, float, float]) -> None:
    """5 % of the stiffness: the normal turns and the grid's slope is not quite 1 over the 40 um of the quotient."""
    step = 2e-5
    slope = probed(ring(0.001), velocity)[2]
    quotient = (probed(ring(0.001 + step), velocity)[1] - probed(ring(0.001 - step), velocity)[1]) / (2 * step)
    np.testing.assert_allclose(slope, quotient, atol=0.05 * method.STIFFNESS)


def test_points_outside_leak_a_share_of_the_slope() -> None:
    assert np.all(probed(ring(-0.002), (0.0, 0.0, 0.01))[1] == 0), "points outside press with nothing"
    outside, inside = (probed(ring(depth))[2] for depth in (-0.001, 0.001))
    np.testing.assert_allclose(outside, method.LEAK * inside, atol=0.02 * method.STIFFNESS)


def touching_batch() -> _Batch:
    """The palm 0.02 mm inside a face of the box, the fingers clear of it, all standing still."""
    pair = load_pair(two_finger_hand(), BOX, "cpu", kernels)
    start = HandState(np.array([[0.0, 0, -0.025 + 2e-5]]), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 2)))
    batch = _Batch(Search(pair, CELLS), start, 10)
    batch.data.pivot.assign([wp.vec3(*start.pivot[0])])
    batch.data.schedule.dilation.zero_()
    batch.data.iteration.fill_(9)
    batch.physics.warmup = 1.0
    return batch


def settled(pull: float) -> tuple[np.ndarray, np.ndarray]:
    """Relaxed forces (N, 3, 3) under a constant pull of the task on x, and the contact forces (N, 3, 3)."""
    batch = touching_batch()
    batch.pull.assign([[kernels.vec6(pull, 0, 0, 0, 0, 0)] * 3])
    launches = dict(batch.launches.named_commands())
    launches["forward"].launch()
    for _ in range(800):
        launches["relax"].launch()
    model, data = batch.model, batch.data
    body, place = model.point_body.numpy(), data.body_p.numpy()[0]
    points = place[body] + model.point_position.numpy()
    forces = [probed(points, tuple(v), batch.grid)[1] for v in batch.velocity.numpy()]
    return batch.force.numpy()[0], np.stack(forces, axis=1)


def test_relaxation_departs_from_hard_contact_as_its_weight_says() -> None:
    relaxed, hard = settled(0.0)
    assert np.abs(hard).max() > 0.5
    np.testing.assert_allclose(relaxed, hard, atol=0.02)
    for pull in (0.01, 0.04):
        relaxed, hard = settled(pull)
        np.testing.assert_allclose((relaxed - hard)[..., 0], -pull / (2 * method.MISMATCH), atol=0.02)
