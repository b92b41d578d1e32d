"""GraspIt!'s annealing: schedule, contact energy, eigengrasps, and that the search searches."""

import numpy as np
import pytest
import trimesh
import warp as wp

from graspd.baselines.common import inner_side_points, load_pair
from graspd.baselines.graspit import kernels
from graspd.baselines.graspit.kernels import FIRST_STEP
from graspd.baselines.graspit.method import EACH, ON_PALM, Search, eigengrasps
from graspd.service.model.errors import InputError
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.hands.load import hand_from_path
from graspd.worker.planners.threads import StepCounter
from tests.worker.models import object_from_mesh, two_finger_hand


@wp.kernel(enable_backward=False)
def _schedule(step_in: float, uniform_in: float, rise_in: float, out: wp.array[wp.vec3]):
    cold = kernels.temperature(step_in)
    out[0] = wp.vec3(cold, kernels.jump_share(uniform_in, cold), kernels.acceptance(rise_in, cold))


@wp.kernel(enable_backward=False)
def _evaluated(
    problem: kernels.Problem, state: kernels.vec8, p: wp.array2d[wp.vec3], q: wp.array2d[wp.quat], out: wp.array[float]
):
    kernels.pose_bodies(problem, 0, state, p, q)
    out[0] = kernels.contact_energy(problem, 0, p, q)


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
    return Search(load_pair(two_finger_hand(), box, "cpu", kernels))


def palm_only(gap: float, turn: float) -> float:
    """Contact energy with one virtual contact in the middle of the palm, which looks along z at a box's face."""
    problem = search_on(0.2, 0.2, 0.1).problem
    problem.contact_body = wp.array([0], dtype=wp.int32, device="cpu")
    problem.contact_position = wp.array([[0.0, 0, 0]], dtype=wp.vec3, device="cpu")
    problem.contact_normal = wp.array([[0.0, 0, 1]], dtype=wp.vec3, device="cpu")
    state = kernels.vec8(0, 0, -0.05 - gap, np.pi / 2, 0, turn, 0, 0)
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
    shelves = load_pair(two_finger_hand(), object_from_mesh(trimesh.util.concatenate(boards)), "cpu", kernels)
    with pytest.raises(InputError, match="no collision-free start"):
        Search(shelves).run([[0]], steps=FIRST_STEP + 1, keep=1, tell=StepCounter(1, DEFAULT_CONTEXT))
