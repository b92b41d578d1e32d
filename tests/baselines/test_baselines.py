"""Published methods: energies, annealing, contact forces and closing fingers, against values of their formulas."""

from functools import cache

import numpy as np
import pytest
import trimesh
import warp as wp

from graspd.baselines.autograsp import kernels as autograsp
from graspd.baselines.autograsp.method import TOUCH_M, HandCloser
from graspd.baselines.common import inner_side_points, load_pair
from graspd.baselines.dfc import kernels as dfc
from graspd.baselines.dfc.method import DISTANCE, Descent, sample_starts
from graspd.baselines.graspd2022 import kernels as graspd2022
from graspd.baselines.graspd2022 import method
from graspd.baselines.graspd2022.method import Search as GridSearch
from graspd.baselines.graspd2022.method import _Batch, distance_grid, force_model
from graspd.baselines.graspit import kernels as graspit
from graspd.baselines.graspit.kernels import FIRST_STEP
from graspd.baselines.graspit.method import EACH, ON_PALM, Search, eigengrasps
from graspd.service.model.errors import InputError
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.hands.load import hand_from_path
from graspd.worker.planners.threads import StepCounter
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.kernels.surface import Surface, field_distance
from tests.worker.models import object_from_mesh, two_finger_hand, unit_vectors

BOX = object_from_mesh(trimesh.creation.box((0.05, 0.05, 0.05)))
WEIGHTS = np.array([1.0, 100.0, 100.0, 10.0, 1.0])


def descent_of(pivot: tuple[float, float, float] = (0.0, 0.0, -0.2), q: tuple[float, float] = (0.0, 0.0)) -> Descent:
    pair = load_pair(two_finger_hand(), BOX, "cpu", dfc)
    return Descent(pair, HandState(np.array([pivot]), np.array([[1.0, 0, 0, 0]]), np.array([q])), [[0, 0, 0]])


def evaluated(found: Descent, pivot: tuple[float, float, float], q: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    found.proposal.set_state(HandState(np.array([pivot]), np.array([[1.0, 0, 0, 0]]), np.array([q])))
    found.new_terms.zero_()
    for _, launch in found.launches.named_commands()[1:-2]:
        launch.launch()
    return found.new_terms.numpy()[0].astype(float)


def contacts_at(points: list[list[float]]) -> np.ndarray:
    """Energies with the four contacts at these points of space, on the palm of a hand far away."""
    pivot = (0.0, 0.0, -0.2)
    found = descent_of(pivot)
    found.candidate_body.zero_()
    places = np.zeros((len(found.candidates), 3))
    places[:4] = np.array(points) - pivot
    found.candidate_position.assign(places)
    found.proposed.contact.assign([[0, 1, 2, 3]])
    return evaluated(found, pivot)


@pytest.mark.parametrize(
    ("points", "closure", "distance"),
    [
        # In balance.
        ([[0.025, 0, 0], [-0.025, 0, 0], [0, 0.025, 0], [0, -0.025, 0]], 0.0, 0.0),
        # On one face: |4 n|^2 = 16, and no torque about the middle.
        ([[0.025, 0.01, 0], [0.025, -0.01, 0], [0.025, 0, 0.01], [0.025, 0, -0.01]], 16.0, None),
        # Two couples of arm 0.02 m about z: |2 * 0.02|^2.
        ([[0.025, 0.01, 0], [-0.025, -0.01, 0], [0.025, 0.01, 0], [-0.025, -0.01, 0]], 0.04**2, None),
        # Off the surface on either side of it.
        ([[0.028, 0, 0], [-0.026, 0, 0], [0, 0.023, 0], [0, -0.025, 0]], None, 0.006),
    ],
)
def test_energies_of_contacts(points: list[list[float]], closure: float | None, distance: float | None) -> None:
    terms = contacts_at(points)
    assert closure is None or terms[0] == pytest.approx(closure, rel=1e-3, abs=1e-6)
    assert distance is None or terms[1] == pytest.approx(distance, abs=1e-6)


@pytest.mark.parametrize("q", [(0.1, 0.3), (-0.35, 0.25), (1.3, 1.3)])
def test_the_gradient_is_the_difference_quotient_of_the_energy(q: tuple[float, float]) -> None:
    """Fingers in the box, once beyond a joint limit. Relative 3 %: samples enter pieces one by one.

    Force closure is left out of the quotient: its gradient takes normals as constant, and its torques are small here.
    """
    found, pivot, step = descent_of(), (0.004, 0.003, -0.035), 2e-5
    evaluated(found, pivot, q)
    gradient = found.proposal.gradient.numpy()[0].astype(float)
    quotient = []
    for column in (0, 1, 2, 6, 7):
        ends = []
        for sign in (1, -1):
            moved, turned = list(pivot), list(q)
            (moved if column < 3 else turned)[column % 3] += sign * step
            ends.append(evaluated(found, tuple(moved), tuple(turned))[1:] @ WEIGHTS[1:])  # type: ignore[arg-type]
        quotient.append((ends[0] - ends[1]) / (2 * step))
    np.testing.assert_allclose(gradient[[0, 1, 2, 6, 7]], quotient, rtol=0.03, atol=0.03 * np.abs(quotient).max())


@wp.kernel(enable_backward=False)
def _annealing(iteration_in: wp.array[wp.int32], rise_in: float, uniform_in: wp.array[float], out: wp.array[wp.vec3]):
    i = wp.tid()
    cold = dfc.temperature(iteration_in[i])
    accepted = dfc.is_accepted(rise_in, cold, uniform_in[i])
    out[i] = wp.vec3(dfc.step_size(iteration_in[i]), cold, float(accepted))


def annealed(iteration: list[int], uniform: np.ndarray, rise: float = 0.0) -> np.ndarray:
    """(3, n) size of a step, temperature, and whether the rise is accepted."""
    given = [wp.array(iteration, dtype=wp.int32, device="cpu"), rise, wp.array(uniform, dtype=float, device="cpu")]
    found = wp.zeros(len(iteration), dtype=wp.vec3, device="cpu")
    wp.launch(_annealing, len(iteration), inputs=given, outputs=[found], device="cpu")
    return found.numpy().T


def test_steps_and_temperature_decay_every_50_and_30_iterations() -> None:
    size, cold, _ = annealed([0, 29, 30, 49, 50, 5999], np.zeros(6))
    np.testing.assert_allclose(size, [5e-3, 5e-3, 5e-3, 5e-3, 4.75e-3, 5e-3 * 0.95**119], rtol=1e-4)
    np.testing.assert_allclose(cold, [18, 18, 17.1, 17.1, 17.1, 18 * 0.95**199], rtol=1e-4)


def test_a_fall_is_accepted_and_a_rise_with_its_boltzmann_factor() -> None:
    """20,000 draws at a rise of T: a share of 1/e, standard error 0.3 points."""
    n = 20_000
    uniform = np.random.default_rng(5).random(n)
    assert annealed([0] * n, uniform, -1e-3)[2].all()
    assert annealed([0] * n, uniform, 18.0)[2].mean() == pytest.approx(np.exp(-1), abs=0.015)
    assert annealed([3000] * n, uniform, 18.0)[2].mean() == 0


def test_annealing_ends_at_a_lower_energy_than_it_began() -> None:
    found = descent_of()
    tell = StepCounter(1, DEFAULT_CONTEXT)
    found.run(1, tell)
    before = found.energies()[0] @ WEIGHTS
    found.run(1500, tell)
    assert found.energies()[0] @ WEIGHTS < 0.3 * before and 0 < found.taken.numpy()[0] <= 1501


def test_starts_look_at_the_hull_from_the_given_distance() -> None:
    found = sample_starts(two_finger_hand(), BOX, seed=0, batch=0, indices=range(40))
    signed = trimesh.proximity.signed_distance(trimesh.creation.box((0.05, 0.05, 0.05)), found.pivot)
    assert np.all(-signed <= DISTANCE[1] + 1e-9)
    # Tilted by 30 degrees, the palm is at least cos 30 of the least distance off the face.
    assert np.all(-signed >= np.cos(np.pi / 6) * DISTANCE[0] - 1e-9)


@wp.kernel(enable_backward=False)
def _schedule(step_in: float, uniform_in: float, rise_in: float, out: wp.array[wp.vec3]):
    cold = graspit.temperature(step_in)
    out[0] = wp.vec3(cold, graspit.jump_share(uniform_in, cold), graspit.acceptance(rise_in, cold))


@wp.kernel(enable_backward=False)
def _evaluated(
    problem: graspit.Problem, state: graspit.vec8, p: wp.array2d[wp.vec3], q: wp.array2d[wp.quat], out: wp.array[float]
):
    graspit.pose_bodies(problem, 0, state, p, q)
    out[0] = graspit.contact_energy(problem, 0, p, q)


def scheduled(step: float, uniform: float = 0.5, rise: float = 0.0) -> list[float]:
    """Temperature, share of the largest jump, and chance of a rise at a step."""
    found = wp.zeros(1, dtype=wp.vec3, device="cpu")
    wp.launch(_schedule, 1, inputs=[step, uniform, rise], outputs=[found], device="cpu")
    return list(map(float, found.numpy()[0]))


def test_temperature_jumps_and_chances_follow_ingbers_schedule() -> None:
    """T(k) = 1e6 exp(-7 k^(1/8)) in float32, which loses 2e-4 in exp(-25)."""
    assert [scheduled(step)[0] for step in (0, 3e4, 7e4)] == pytest.approx([1e6, 9.37e-6, 5.49e-7], rel=5e-3)
    for step, uniform in ((3e4, 0.1), (5e4, 0.6), (7e4, 0.9)):
        t, jump, _ = scheduled(step, uniform)
        assert t == pytest.approx(1e6 * np.exp(-7 * step**0.125), rel=2e-4)
        expected = np.sign(uniform - 0.5) * t * ((1 + 1 / t) ** abs(2 * uniform - 1) - 1)
        assert jump == pytest.approx(expected, rel=2e-4)
    assert [scheduled(5e4, uniform)[1] for uniform in (0.0, 0.5, 1.0)] == pytest.approx([-1, 0, 1], abs=1e-6)
    assert [scheduled(7e4, rise=rise)[2] for rise in (-1.0, 0.0)] == [1.0, 1.0]
    hot, cold = scheduled(3e4, rise=1.0), scheduled(7e4, rise=1.0)
    assert hot[2] == pytest.approx(np.exp(-1e-6 / hot[0]), rel=2e-4) and cold[2] < hot[2]


def search_on(*sides: float) -> Search:
    box = object_from_mesh(trimesh.creation.box(sides))
    return Search(load_pair(two_finger_hand(), box, "cpu", graspit))


def palm_only(gap: float, turn: float) -> float:
    """Contact energy with one virtual contact in the middle of the palm, which looks along z at a box's face."""
    problem = search_on(0.2, 0.2, 0.1).problem
    problem.contact_body = wp.array([0], dtype=wp.int32, device="cpu")
    problem.contact_position = wp.array([[0.0, 0, 0]], dtype=wp.vec3, device="cpu")
    problem.contact_normal = wp.array([[0.0, 0, 1]], dtype=wp.vec3, device="cpu")
    state = graspit.vec8(0, 0, -0.05 - gap, np.pi / 2, 0, turn, 0, 0)
    poses = [wp.zeros((1, 3), dtype=kind, device="cpu") for kind in (wp.vec3, wp.quat)]
    energy = wp.zeros(1, dtype=wp.float32, device="cpu")
    wp.launch(_evaluated, 1, inputs=[problem, state], outputs=[*poses, energy], device="cpu")
    return float(energy.numpy()[0])


@pytest.mark.parametrize(
    ("gap", "turn", "expected"),
    [
        (0.0, 0.0, 0.0),  # in contact, normals aligned
        (0.001, 0.0, 1.0),  # a millimetre off
        (0.001, np.pi / 3, 1.0 + 50 * (1 - 0.5)),  # turned by 60 degrees about x
        (0.03, 0.0, 30.0),
    ],
)
def test_contact_energy_is_distance_and_misalignment(gap: float, turn: float, expected: float) -> None:
    """Absolute 0.01 near the surface; 0.3 mm far from it, where a grid of 5 mm cells answers."""
    assert palm_only(gap, turn) == pytest.approx(expected, abs=0.3 if gap > 0.01 else 0.01)


def test_barrett_has_graspits_own_eigengrasps() -> None:
    hand = hand_from_path("barrett")
    found = eigengrasps(hand)
    spread = (np.asarray(hand.closing) == 0).astype(float)
    np.testing.assert_array_equal(found.directions, [spread, hand.closing])


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_contacts_lie_on_every_finger_amplitudes_reach_limits(name: str) -> None:
    hand = hand_from_path(name)
    found = inner_side_points(hand, each=EACH, on_palm=ON_PALM)
    assert set(hand.fingertips) <= set(found.body.tolist())
    palm = found.normal[found.body == 0]
    assert len(palm) >= 1 and np.all(palm @ hand.palm.approach > 0.7)
    found = eigengrasps(hand)
    corners = np.array([[a, b] for a in found.limits[0] for b in found.limits[1]])
    q = found.posture(corners, hand)
    assert np.all(q >= hand.lower) and np.all(q <= hand.upper)
    moving = np.any(found.directions != 0, axis=0)
    assert np.any(np.ptp(q, axis=0)[moving] > 0.5 * (hand.upper - hand.lower)[moving])


def test_annealing_lowers_energy_and_keeps_states_that_differ() -> None:
    search = search_on(0.05, 0.05, 0.05)
    told: list[float] = []
    steps = StepCounter(1e6, ExecutionContext(progress=lambda done, total, message: told.append(done)))
    few = search.run([[0, 0, c] for c in range(4)], steps=FIRST_STEP + 50, keep=1, tell=steps)
    assert told[-1] == 4 * 50
    many = search.run([[0, 0, c] for c in range(4)], steps=FIRST_STEP + 2000, keep=1, tell=steps)
    assert np.linalg.norm(many.pivot, axis=1).mean() < np.linalg.norm(few.pivot, axis=1).mean()
    kept = search.run([[3]], steps=FIRST_STEP + 1500, keep=4, tell=StepCounter(1, DEFAULT_CONTEXT))
    apart = np.linalg.norm(kept.pivot[:, None] - kept.pivot[None], axis=2)
    assert len(kept.pivot) == 4 and np.any(apart[np.triu_indices(4, 1)] > 0.005)


def test_a_hand_that_fits_nowhere_is_told() -> None:
    boards = [trimesh.creation.box((0.8, 0.8, 0.03)).apply_translation([0, 0, 0.045 * k]) for k in range(-10, 11)]
    shelves = load_pair(two_finger_hand(), object_from_mesh(trimesh.util.concatenate(boards)), "cpu", graspit)
    with pytest.raises(InputError, match="no collision-free start"):
        Search(shelves).run([[0]], steps=FIRST_STEP + 1, keep=1, tell=StepCounter(1, DEFAULT_CONTEXT))


#: Hand points are 9 mm apart on these fingers: a curved link may come this much nearer between two of them [m].
SAMPLED = 1.5e-3


def closer_on(*box: float) -> HandCloser:
    obj = object_from_mesh(trimesh.creation.box(box))
    return HandCloser(load_pair(two_finger_hand(), obj, "cpu", autograsp), 1)


def distances(closer: HandCloser, state: HandState) -> np.ndarray:
    closer.data.set_state(state)
    closer._measure()
    return closer.near.numpy()


def closed(box: tuple[float, float, float], shift: float = 0.0) -> tuple[np.ndarray, list[int], np.ndarray]:
    """Close two fingers, 80 mm apart, on a box in front of the palm.
    Return joint positions, why each dof stopped, and each body's distance from the box [m]."""
    closer = closer_on(*box)
    pivot = np.array([[shift, 0.0, -0.06]])
    found = closer.close(HandState(pivot, np.array([[1.0, 0, 0, 0]]), np.zeros((1, 2))))
    return found.q[0], closer.stopped.numpy()[0].tolist(), distances(closer, found)[0]


def test_each_finger_stops_at_its_own_first_contact() -> None:
    q, stopped, distance = closed((0.03, 0.05, 0.05), shift=0.005)
    assert stopped == [1, 1] and np.all(distance[1:] < TOUCH_M)
    assert np.all(distance[1:] > -TOUCH_M)
    # The box is nearer to one finger: the other went on after that one had stopped.
    assert abs(q[0] - q[1]) > 0.1


def test_a_finger_that_meets_nothing_closes_to_its_limit() -> None:
    q, _, distance = closed((0.01, 0.01, 0.01), shift=0.2)
    assert np.all(distance > 0.02) and np.all(q > 0.2)


@pytest.mark.parametrize("thickness", [1e-3, 1e-4])
def test_nothing_is_passed_through_however_thin(thickness: float) -> None:
    q, stopped, distance = closed((thickness, 0.06, 0.06))
    assert stopped == [1, 1] and np.all(distance[1:] > -SAMPLED)
    # Symmetric: both fingers ended on their own side.
    assert np.allclose(q[0], q[1], atol=0.02)


def test_the_approach_ends_at_the_standoff() -> None:
    closer = closer_on(0.03, 0.03, 0.03)
    start = HandState(np.array([[0.0, 0.0, -0.15]]), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 2)))
    there = closer.approach(start, 0.004)
    assert distances(closer, there).min() == pytest.approx(0.004, abs=3e-4) and there.pivot[0, 2] > -0.1


RADIUS = 0.05
SPHERE = object_from_mesh(trimesh.creation.icosphere(subdivisions=4, radius=RADIUS))
CELLS = 48
#: Farthest that the sphere's flat faces lie inside the sphere [m].
SAGITTA = RADIUS - float(np.linalg.norm(SPHERE.vertices[SPHERE.faces].mean(axis=1), axis=1).min())


@cache
def grid_of_sphere(cells: int):
    return distance_grid(load_pair(two_finger_hand(), SPHERE, "cpu", graspd2022).fine.obj, cells)


@wp.kernel(enable_backward=False)
def _probe(
    physics: graspd2022.ForceModel,
    surface: Surface,
    points: wp.array[wp.vec3],
    speed: wp.vec3,
    out: wp.array2d[wp.vec3],
):
    i = wp.tid()
    sample = field_distance(surface, points[i])
    out[0, i] = wp.vec3(sample.distance)
    out[1, i] = graspd2022.contact_force(physics, -sample.distance, sample.normal, speed)
    out[2, i] = graspd2022.force_slope(physics, -sample.distance, sample.normal, speed)


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
    box = distance_grid(load_pair(two_finger_hand(), BOX, "cpu", graspd2022).fine.obj, CELLS)
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
    pair = load_pair(two_finger_hand(), BOX, "cpu", graspd2022)
    start = HandState(np.array([[0.0, 0, -0.025 + 2e-5]]), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 2)))
    batch = _Batch(GridSearch(pair, CELLS), start, 10)
    batch.data.pivot.assign([wp.vec3(*start.pivot[0])])
    batch.data.schedule.dilation.zero_()
    batch.data.iteration.fill_(9)
    batch.physics.warmup = 1.0
    return batch


def settled(pull: float) -> tuple[np.ndarray, np.ndarray]:
    """Relaxed forces (N, 3, 3) under a constant pull of the task on x, and the contact forces (N, 3, 3)."""
    batch = touching_batch()
    batch.pull.assign([[graspd2022.vec6(pull, 0, 0, 0, 0, 0)] * 3])
    launches = dict(batch.launches.named_commands())
    launches["forward"].launch()
    for _ in range(800):
        launches["relax"].launch()
    model, data = batch.model, batch.data
    body, pose_bodies = model.point_body.numpy(), data.body_p.numpy()[0]
    points = pose_bodies[body] + model.point_position.numpy()
    forces = [probed(points, tuple(v), batch.grid)[1] for v in batch.velocity.numpy()]
    return batch.force.numpy()[0], np.stack(forces, axis=1)


def test_relaxation_departs_from_hard_contact_as_its_weight_says() -> None:
    relaxed, hard = settled(0.0)
    assert np.abs(hard).max() > 0.5
    np.testing.assert_allclose(relaxed, hard, atol=0.02)
    for pull in (0.01, 0.04):
        relaxed, hard = settled(pull)
        np.testing.assert_allclose((relaxed - hard)[..., 0], -pull / (2 * method.MISMATCH), atol=0.02)
