"""The projection's steps against NumPy, its sums in integers; the order of threads and CUDA graphs move no bit."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import warp as wp

from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.transforms import quat_from_axis_angle, quat_multiply
from graspd.worker.control.postures import pregrasp
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses, generalized_forces
from graspd.worker.hands.surface import sample_surface
from graspd.worker.planners import PlanRequest
from graspd.worker.planners.fast_graspd import planner
from graspd.worker.planners.fast_graspd.candidates import posture_of
from graspd.worker.simulation import launches
from graspd.worker.simulation.data import Data, HandState, allocate_contacts, zero_schedule
from graspd.worker.simulation.device import DeviceHand, DeviceObject
from graspd.worker.simulation.kernels import packing, wrenches
from graspd.worker.simulation.kernels import projection as kernels
from graspd.worker.simulation.kernels.wrenches import Wrenches, add_wrench
from graspd.worker.simulation.launches import Launches
from graspd.worker.simulation.model import LossOptions, Model
from graspd.worker.simulation.projection import Projection, ProjectionOptions
from graspd.worker.simulation.sampling import object_samples
from tests.worker.models import object_from_mesh, two_finger_hand

HAND = two_finger_hand()
BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
HANDS = 6
SINGLE = 2e-6  # distances, rows and poses are in single precision, so steps of millimetres are good to this
FIDELITY = FIDELITIES["draft"].model_copy(update={"coarse_iterations": 20, "fine_iterations": 20})


def pressing() -> HandState:
    """Hands whose fingers stand in the box, each a little more closed than the one before."""
    pivot = np.tile(HAND.palm.centre + np.array([0.001, 0, -0.095]), (HANDS, 1))
    q = np.linspace(0.3, 0.5, HANDS)[:, None] * [1.0, 0.9]
    return HandState(pivot, np.tile([1.0, 0, 0, 0], (HANDS, 1)), q)


def projection() -> Projection:
    obj = DeviceObject.create(BOX, "cpu", samples=object_samples(BOX, 500), phong_alpha=0.0, cell=0.005)
    points = sample_surface(HAND, 400)
    model = Model.create(DeviceHand.create(HAND, "cpu"), obj, points, points, LossOptions())
    return Projection(model, Data(model, HANDS), ProjectionOptions())


def evaluated(state: HandState) -> Projection:
    """Residuals and equations of a state, without a step."""
    out = projection()
    out.data.set_schedule(zero_schedule())
    out.data.set_state(state)
    out._depth.fill_(np.inf)
    launches = out._record_depths(out._states(state), out._states(state))
    out._add_equations(launches)
    launches.run()
    return out


def equations(found: Projection, state: HandState, b: int) -> tuple[np.ndarray, np.ndarray, int]:
    """J'WJ (n, n), J'We (n,) and the number of residuals of hand b, in double precision."""
    r = found.residuals
    count = int(r.count.numpy()[b])
    body, other, point, direction, value, weight = (
        getattr(r, name).numpy()[b, :count] for name in ("body", "other", "point", "direction", "value", "weight")
    )
    posture = posture_of(HAND, BOX, state[b : b + 1])
    poses = body_poses(HAND, posture.hand_pose, posture.joint_positions)[0]
    poses[:, :3] -= BOX.centre_of_mass
    rows = np.zeros((count, 6 + HAND.dofs))
    rows[:, 6:] = generalized_forces(HAND, poses, body, point, direction[:, None])[:, 0]
    both = other >= 0
    rows[both, 6:] -= generalized_forces(HAND, poses, other[both], point[both], direction[both, None])[:, 0]
    rows[~both, :3] = direction[~both]
    rows[~both, 3:6] = np.cross(point[~both] - state.pivot[b], direction[~both])
    return rows.T @ (weight[:, None] * rows), rows.T @ (weight * value), count


def test_the_equations_are_those_of_the_residuals() -> None:
    state = pressing()
    found = evaluated(state)
    for b in range(HANDS):
        matrix, vector, count = equations(found, state, b)
        assert count > 10
        lower = np.tril(found.matrix.numpy()[b] / kernels.FIXED)
        np.testing.assert_allclose(lower, np.tril(matrix), atol=SINGLE * count)
        np.testing.assert_allclose(found.vector.numpy()[b] / kernels.FIXED, vector, atol=1e-9 * count)


def test_a_step_solves_them() -> None:
    state = pressing()
    found = evaluated(state)
    moved, depth = projection().run(state, 1)
    _, before = projection().run(state, 0)
    # Of both states the less deep one is told, so the step is seen where it helped.
    assert (depth < before - 1e-4).all()
    scale = np.repeat(found.options.scale, [3, 3, HAND.dofs])
    for b in range(HANDS):
        matrix, vector, count = equations(found, state, b)
        damped = scale[:, None] * matrix * scale + found.options.damping * count * np.eye(len(scale))
        step = -np.linalg.solve(damped, scale * vector)
        step *= scale * min(1.0, found.options.step / np.linalg.norm(step))
        angle = np.linalg.norm(step[3:6])
        turned = quat_multiply(quat_from_axis_angle(step[3:6] / angle, angle), state.rotation[b])
        np.testing.assert_allclose(moved.pivot[b], state.pivot[b] + step[:3], atol=SINGLE)
        np.testing.assert_allclose(moved.rotation[b], turned, atol=SINGLE)
        q = np.clip(state.q[b] + step[6:], HAND.lower, HAND.upper)
        np.testing.assert_allclose(moved.q[b], q, atol=10 * SINGLE)


def test_hands_without_penetration_stay_where_they_are() -> None:
    state = pressing()
    state.pivot[:, 2] -= 0.2
    state.q *= 0.5
    moved, depth = projection().run(state, 10)
    assert not depth.any()
    np.testing.assert_array_equal(moved.pivot, state.pivot)
    np.testing.assert_array_equal(moved.q, state.q)


@wp.kernel
def add_all(force_in: wp.array(dtype=wp.vec3), wrench_inout: Wrenches):
    i = wp.tid()
    add_wrench(wrench_inout, 0, 0, force_in[i], 0.1 * force_in[i])


def summed(forces: np.ndarray) -> np.ndarray:
    """Counts (6,) of all forces (n, 3) and a tenth of them as torques."""
    wrench = wp.zeros((1, 1, 6), dtype=wp.int64, device="cpu")
    given = wp.array(forces.astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(add_all, len(forces), inputs=[given], outputs=[wrench], device="cpu")
    return wrench.numpy()[0, 0]


def test_wrenches_add_up_with_the_same_bits_in_any_order() -> None:
    # Sizes from 1e-3 to 1e4, as in a batch: float32 sums of them differ in their last digits.
    rng = np.random.default_rng(5)
    forces = rng.normal(size=(500, 3)) * 10.0 ** rng.uniform(-3, 4, (500, 1))
    shuffled = forces[rng.permutation(500)]
    plain, other = (np.add.accumulate(some.astype(np.float32))[-1] for some in (forces, shuffled))
    assert (plain != other).any() and (summed(forces) == summed(shuffled)).all()
    forces = np.random.default_rng(6).normal(size=(300, 3)).astype(np.float32)
    force, torque = np.split(summed(forces) * wrenches.UNIT, 2)
    # Each addend loses less than one count, and the tenth is rounded to float32.
    np.testing.assert_allclose(force, forces.astype(float).sum(axis=0), atol=300 * wrenches.UNIT)
    np.testing.assert_allclose(torque, 0.1 * forces.astype(float).sum(axis=0), atol=1e-5)
    assert (summed(np.array([[np.nan, np.inf, -np.inf]])) == 0).all()


@pytest.mark.parametrize("count", [1, 31, 32, 33, 95])
def test_marked_points_get_the_slots_of_a_counter(count: int) -> None:
    mark = np.random.default_rng(count).integers(0, 3, (4, count)).astype(np.int32)
    active = wp.array([1, 1, 0, 1], dtype=wp.int32)
    counts = [wp.zeros((4, -(-count // packing.CHUNK)), dtype=wp.int32) for _ in range(2)]
    marked, packed = allocate_contacts(4, count, marked=True), allocate_contacts(4, count)
    marked.mark.assign(mark)
    marked.body.assign(np.tile(np.arange(count, dtype=np.int32), (4, 1)))
    packed.count.fill_(-1)
    wp.launch(packing.count_marks, counts[0].shape, inputs=[active, marked.mark], outputs=counts, device="cpu")
    wp.launch(packing.pack, (4, count), inputs=[active, marked, *counts], outputs=[packed], device="cpu")
    for b in (0, 1, 3):
        kept, close = np.flatnonzero(mark[b]), np.flatnonzero(mark[b] == packing.NEAR)
        assert packed.count.numpy()[b] == len(kept) and packed.near_count.numpy()[b] == len(close)
        assert (packed.body.numpy()[b, : len(kept)] == kept).all()
        assert (kept[packed.near.numpy()[b, : len(close)]] == close).all()
    assert packed.count.numpy()[2] == -1


def planned() -> planner.LaunchPart:
    box = object_from_mesh(trimesh.creation.box((0.05, 0.05, 0.08)))
    request, run = PlanRequest(2, FIDELITY, seed=3), ExecutionContext("cpu", threads=1)
    (part,) = planner.optimise_batch(HAND, box, request, run)
    return part


def check_same(one: HandState, other: HandState) -> None:
    for name in ("pivot", "rotation", "q"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_batch_has_the_same_bits_where_threads_come_in_any_order(monkeypatch: pytest.MonkeyPatch) -> None:
    states = []
    for serial in (True, False):
        monkeypatch.setattr(planner, "Data", partial(Data, serial=serial))
        states.append(planned().state)
    check_same(*states)


def replayed_graphs(monkeypatch: pytest.MonkeyPatch) -> list:
    """Graphs that `Launches` replays from now on, for a device that is said to be CUDA."""
    replayed = []

    def replay(graph) -> None:
        replayed.append(graph)
        wp.capture_launch(graph)

    seen = {"launch": wp.launch, "ScopedCapture": wp.ScopedCapture, "capture_launch": replay}
    monkeypatch.setattr(launches, "wp", SimpleNamespace(get_device=lambda _: SimpleNamespace(is_cuda=True), **seen))
    return replayed


def forbid_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = Launches.run

    def run(self: Launches, times: int = 1) -> None:
        with pytest.MonkeyPatch.context() as forbidden:
            for name in ("numpy", "assign", "fill_", "zero_"):
                forbidden.setattr(wp.array, name, None)
            for name in ("zeros", "empty", "full", "copy", "load_module", "synchronize", "synchronize_device"):
                forbidden.setattr(wp, name, None)
            plain(self, times)

    monkeypatch.setattr(Launches, "run", run)


def opened() -> Posture:
    """Pregrasps of hands in touch: one that opens along its normals, one that has to open plainly."""
    grasp = Posture(np.tile([0, 0, -0.095, 1.0, 0, 0, 0], (2, 1)), np.array([[0.4, 0.4], [0.1, 0.8]]))
    return pregrasp(HAND, BOX, grasp)


def test_replayed_graphs_give_the_hands_of_plain_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, plainly_opened = planned(), opened()
    replayed = replayed_graphs(monkeypatch)
    forbid_the_host(monkeypatch)
    check_same(plain.state, planned().state)
    while_planning, reopened = len(replayed), opened()
    assert 0 < while_planning < len(replayed)
    np.testing.assert_array_equal(plainly_opened.joint_positions, reopened.joint_positions)
    np.testing.assert_array_equal(plainly_opened.hand_pose, reopened.hand_pose)
