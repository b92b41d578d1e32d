"""The contact kernels against the float64 reference, points that must not touch, and the projection's steps."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import warp as wp

from benchmarks.integrators import reference
from benchmarks.integrators.gradients import SOLVERS, reference_gradient, run_kernel
from benchmarks.integrators.reference import Contacts, World
from graspd.service.model.contact_region import parse_region
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.transforms import quat_from_axis_angle, quat_multiply
from graspd.worker.control.postures import pregrasp
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import Posture
from graspd.worker.hands.digits import Part
from graspd.worker.hands.kinematics import body_poses, generalized_forces
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.region import ContactRegion
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
from graspd.worker.simulation.model import (
    ANYWHERE,
    NEAR_GAP,
    NO_CONTACT_M,
    AllowedContacts,
    LossOptions,
    Model,
    initial_motions,
)
from graspd.worker.simulation.projection import Projection, ProjectionOptions
from graspd.worker.simulation.record import record_evaluation
from graspd.worker.simulation.sampling import object_samples
from tests.worker.models import object_from_mesh, two_finger_hand, unit_vectors
from tests.worker.simulation.rigs import rig, still

END_TOLERANCE = 2e-6  # float32 solves of 6 x 6 systems with condition numbers up to 1e3, motions of 1e-3 m
#: Cosine between the kernel's adjoint and central differences: contacts that switch on or off within the difference,
#: and the fixed slip direction, are what differs.
COSINE = 0.97
INERTIA = np.diag([8e-4, 6e-4, 4e-4])
WORLD = World(inertia=INERTIA, gyration=float(np.sqrt(np.trace(INERTIA) / 3)))
MOTIONS = initial_motions(7, WORLD.step, WORLD.gyration)
run = partial(run_kernel, near_gap=NEAR_GAP, lane=5)
EACH = pytest.mark.parametrize("name", SOLVERS)


def ring(rng: np.random.Generator, count: int = 24, gap: float = -1e-4, spread: float = 2e-4) -> Contacts:
    """Contacts all around a ball of 4 cm."""
    normals = unit_vectors(rng, count)
    return Contacts(0.04 * normals, normals, gap + spread * rng.normal(size=count), rng.uniform(0.5, 1.5, count))


@EACH
def test_the_step_ends_where_the_float64_reference_ends(name: str) -> None:
    rng = np.random.default_rng(1)
    scale = np.repeat([1, WORLD.gyration], 3)
    for _ in range(5):
        contacts = ring(rng)
        end, _, _ = run(name, contacts, WORLD)
        expected = SOLVERS[name][1](contacts, MOTIONS, WORLD)
        np.testing.assert_allclose(end * scale, expected * scale, atol=END_TOLERANCE)


@EACH
def test_gradient_agrees_with_central_differences_of_reference(name: str) -> None:
    rng = np.random.default_rng(2)
    cosines = []
    for _ in range(5):
        contacts = ring(rng, count=8, gap=-3e-4, spread=1e-4)
        _, _, gradient = run(name, contacts, WORLD)
        numeric = reference_gradient(name, contacts, WORLD)
        cosines.append(gradient @ numeric / np.linalg.norm(gradient) / np.linalg.norm(numeric))
    assert np.median(cosines) > COSINE, cosines


def test_the_list_of_near_contacts_and_the_lane_change_nothing() -> None:
    rng = np.random.default_rng(7)
    for spread in (2e-4, 2e-2):
        contacts = ring(rng, count=40, gap=1e-3, spread=spread)
        whole = run("direct", contacts, WORLD, leak=0.1, near_gap=1.0, lane=1)
        listed = run("direct", contacts, WORLD, leak=0.1)
        for found, expected in zip(listed, whole, strict=True):
            np.testing.assert_array_equal(found, expected)


def test_a_free_object_keeps_its_motion() -> None:
    far = Contacts(np.array([[0, 0, 0.04]]), np.array([[0, 0, 1.0]]), np.array([0.01]), np.ones(1))
    for name in SOLVERS:
        end, loss, gradient = run(name, far, WORLD)
        np.testing.assert_allclose(end, MOTIONS, atol=1e-9)
        assert np.all(gradient == 0)
        assert loss[0] < 0.05, "an object at rest that nothing touches stays at rest, up to the smoothing"


def test_friction_never_leaves_the_cone_sticks_and_slips() -> None:
    rng = np.random.default_rng(3)
    stuck = slid = 0
    for friction in (0.1, 0.8, 3.0):
        world, contacts = replace(WORLD, friction=friction), ring(rng)
        normal, slip = np.moveaxis(reference.gauss_seidel(contacts, MOTIONS, world)[1], -1, 0)
        assert np.all(slip <= friction * normal * (1 + 1e-12))
        sticks = slip < friction * normal * (1 - 1e-9)
        stuck += np.sum((slip > 0) & sticks)
        slid += np.sum((normal > 0) & ~sticks)
    assert stuck > 0 and slid > 0


def test_an_object_between_fingers_sticks_or_slides_by_friction() -> None:
    points = np.array([[0.03, 0, 0], [-0.03, 0, 0]])
    squeeze = Contacts(points, points / 0.03, np.full(2, -1e-3), np.full(2, 50.0))
    for name in SOLVERS:
        rough, smooth = replace(WORLD, friction=2.0), replace(WORLD, friction=1e-6)
        along_y = 3  # motions: rest, +x, -x, +y, ...
        # One sweep leaves part of the slip that the second contact causes at the first.
        assert abs(run(name, squeeze, rough)[0][along_y, 1]) < 0.35 * WORLD.step
        assert abs(run(name, squeeze, smooth)[0][along_y, 1]) > 0.9 * WORLD.step


def test_one_contact_gives_object_the_momentum_of_its_impulse() -> None:
    """Off-centre and without friction: M s = lambda (n, p x n) with lambda = -C / w, in closed form."""
    point, normal, depth = np.array([0.04, 0.01, -0.02]), np.array([0.0, 0.6, 0.8]), 1e-3
    single = Contacts(point[None], normal[None], np.array([-depth]), np.ones(1))
    world = replace(WORLD, friction=1e-9)
    arm = np.cross(point, normal)
    w = 1.0 + arm @ np.linalg.inv(INERTIA) @ arm
    impulse = -depth / w
    expected = np.concatenate([impulse * normal, np.linalg.inv(INERTIA) @ (impulse * arm)])
    np.testing.assert_allclose(run("gauss_seidel", single, world)[0][0], expected, rtol=1e-5, atol=1e-9)


def test_a_balanced_grasp_leaves_the_object_at_rest_without_nan() -> None:
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    balanced = Contacts(0.04 * axes, axes, np.full(6, -5e-4), np.ones(6))
    np.testing.assert_allclose(run("direct", balanced, WORLD)[0][0], 0, atol=1e-8)
    touching = Contacts(np.zeros((3, 3)), np.eye(3), np.zeros(3), np.ones(3))
    for name in SOLVERS:
        for part in run(name, touching, WORLD, leak=0.1):
            assert np.all(np.isfinite(part))


@EACH
def test_the_one_sided_leak_only_draws_free_points_nearer(name: str) -> None:
    free = ring(np.random.default_rng(5), gap=5e-3, spread=1e-4)
    one = run(name, free, WORLD, leak=0.1)[2]
    two = run(name, free, WORLD, leak=0.1, one_sided=False)[2]
    # Descending a positive dL/drho shortens the distance.
    assert np.all(one >= 0) and one.max() > 0
    assert np.abs(two).max() < 0.1 * one.max(), "two-sided: opposite velocities cancel where nothing touches"


HAND = two_finger_hand()
#: A box away from the origin, so that a region in its frame differs from one about its centre of mass.
AT = trimesh.transformations.translation_matrix((0.1, -0.2, 0.3))
BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05), AT))
#: With this band, all points of the hand are candidates, so that two models list the same ones.
EVERY = LossOptions(band=0.5, pull=0.01, range_weight=0.0)
PENALTY = 2.0
LEFT = AllowedContacts(np.array([Part.WHOLE, Part.NONE, Part.WHOLE], np.int32))
#: Single precision of coordinates around 0.1 m.
SINGLE = 2e-7


def state(close: float = 0.45, back: float = 0.0) -> HandState:
    """Both fingers in the box, unless the hand is moved back."""
    return HandState(np.array([[0.001, 0, -0.095 - back]]), np.array([[1.0, 0, 0, 0]]), np.full((1, 2), close))


def evaluated(allowed: AllowedContacts, options: LossOptions = EVERY, at: HandState | None = None) -> dict:
    """Contacts (N,) of one hand, with its loss, gradient and depth."""
    model, data = rig(HAND, BOX, capacity=1, options=options, allowed=allowed, alpha=0.0)
    data.set_schedule(replace(still(dilation=1e-3), penetration=np.full(1, PENALTY)))
    data.set_state(at or state())
    record_evaluation(model, data).run()
    names = ("body", "point", "normal", "distance", "weight", "gradient")
    found = {name: getattr(data.contacts, name).numpy()[0] for name in names}
    assert data.contacts.count.numpy()[0] == model.count
    found["near"] = data.contacts.near.numpy()[0, : data.contacts.near_count.numpy()[0]]
    return found | {"loss": data.loss.numpy()[0], "step": data.gradient.numpy()[0], "depth": data.depths.points.numpy()}


def test_limits_that_allow_everything_change_no_bit() -> None:
    free, limited = evaluated(ANYWHERE), evaluated(AllowedContacts(np.full(3, Part.WHOLE, np.int32)))
    for name, values in free.items():
        np.testing.assert_array_equal(limited[name], values, err_msg=name)
    assert (free["weight"] > 0).all() and len(free["near"]) and np.abs(free["step"]).max() > 0


def test_points_of_an_excluded_finger_keep_the_clearance_and_are_no_contacts() -> None:
    free, limited = evaluated(ANYWHERE), evaluated(LEFT)
    left = free["body"] == 1
    np.testing.assert_array_equal(limited["weight"], np.where(left, -1, 1) * free["weight"])
    shift = free["distance"] - limited["distance"]
    assert shift == pytest.approx(np.where(left, NO_CONTACT_M, 0.0), abs=SINGLE)
    assert set(limited["near"]) == set(free["near"]) - set(np.flatnonzero(left)) and len(limited["near"])
    assert (limited["gradient"][left] == 0).all() and np.abs(free["gradient"][left]).max() > 0
    # The clearance counts as penetration. Its penalty w |w_i| rho_i^2 alone turns the excluded finger about y.
    assert limited["depth"] == pytest.approx(-limited["distance"].min(), abs=SINGLE)
    inside = left & (limited["distance"] < 0)
    arm = (limited["point"] - state().pivot - HAND.origin[1, :3])[inside]
    force = 2 * PENALTY * np.abs(free["weight"] * limited["distance"])[inside, None] * -limited["normal"][inside]
    assert inside.sum() >= 3
    assert limited["step"][6] == pytest.approx((force * np.cross([0, 1, 0], arm)).sum(), rel=1e-3)


def test_contact_forces_are_those_of_the_allowed_points_alone() -> None:
    names, rng = ("points", "normals", "distances", "weights"), np.random.default_rng(1)
    some, more = ring(rng), ring(rng, count=9)
    both = Contacts(*(np.concatenate([getattr(one, name) for one in (some, more)]) for name in names))
    guarded = replace(both, weights=np.where(np.arange(33) < 24, both.weights, -both.weights))
    alone, found = (run_kernel("direct", given, WORLD, near_gap=NEAR_GAP, lane=5) for given in (some, guarded))
    for one, other in zip(alone[:2], found[:2], strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(found[2], np.append(alone[2], np.zeros(9)))


@pytest.mark.parametrize("simulate", [True, False], ids=["pull", "control"])
def test_points_that_must_not_touch_are_not_attracted(simulate: bool) -> None:
    """Neither by the term of the planner, nor by the control without simulation."""
    options = replace(EVERY, simulate=simulate, leak=0.0 if simulate else 0.1, pull=EVERY.pull * simulate)
    free, limited = (evaluated(one, options, state(0.45, back=0.05)) for one in (ANYWHERE, LEFT))
    assert (free["distance"] > NO_CONTACT_M).all()
    assert limited["step"][6] == 0.0 != free["step"][6] and limited["step"][7] == free["step"][7] != 0.0


@pytest.mark.parametrize(("touch", "avoid"), [("x > 0.1", ""), ("", "x > 0.1"), ("z < 0.28", "x > 0.11, z < 9")])
def test_points_are_guarded_by_the_nearest_place_on_the_object(touch: str, avoid: str) -> None:
    region = ContactRegion(*(np.array(parse_region(text).planes) if text else None for text in (touch, avoid)))
    free, limited = evaluated(ANYWHERE), evaluated(AllowedContacts(region=region))
    place = free["point"] - free["distance"][:, None] * free["normal"] + BOX.centre_of_mass
    clear = np.abs(place[:, [0, 0, 2]] - [0.1, 0.11, 0.28]).min(axis=1) > 1e-5
    np.testing.assert_array_equal((limited["weight"] > 0)[clear], region.contains(place)[clear])
    assert 0 < (limited["weight"] > 0).sum() < len(place)


def test_the_projection_moves_an_excluded_finger_out_to_the_clearance() -> None:
    least = {}
    for allowed in (ANYWHERE, LEFT):
        model, data = rig(HAND, BOX, capacity=1, allowed=allowed, alpha=0.0)
        moved, depth = Projection(model, data, ProjectionOptions()).run(state(0.4), 60)
        found = evaluated(ANYWHERE, at=moved)
        least[allowed is LEFT] = [found["distance"][found["body"] == finger].min() for finger in (1, 2)]
        assert depth[0] < 2e-4
    assert np.abs(least[False]).max() < 2e-3, "both fingers touch"
    assert least[True] == pytest.approx([NO_CONTACT_M, 0.0], abs=2e-3) and least[True][0] > NO_CONTACT_M - 2e-4


def test_the_projection_holds_no_point_that_must_not_touch() -> None:
    model, data = rig(HAND, BOX, capacity=1)
    step, contacts = Projection(model, data, ProjectionOptions()), allocate_contacts(1, 2)
    data.set_state(state())
    for name, values in {"body": [1, 2], "distance": [1e-3] * 2, "weight": [-1.0, 1.0]}.items():
        getattr(contacts, name).assign(np.array([values], np.float32 if name != "body" else np.int32))
    contacts.count.fill_(2)
    step.residuals.count.zero_()
    inputs = [2, data.hands, contacts, step.options.near, step.options.target, 2e-3, 5e-4, 0.02]
    wp.launch(kernels.point_residuals, (1, 1), inputs=inputs, outputs=[step.residuals], device="cpu")
    assert step.residuals.body.numpy()[0, : step.residuals.count.numpy()[0]].tolist() == [2]


def test_solvers_without_limits_on_contacts_refuse_them() -> None:
    with pytest.raises(InputError, match="gauss_seidel allows contact anywhere: use direct"):
        rig(HAND, BOX, capacity=1, options=LossOptions(contact_solver="gauss_seidel"), allowed=LEFT)


AT_ORIGIN = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
HANDS = 6
STEP_M = 2e-6  # distances, rows and poses are in single precision, so steps of millimetres are good to this
FIDELITY = FIDELITIES["draft"].model_copy(update={"coarse_iterations": 20, "fine_iterations": 20})


def pressing() -> HandState:
    """Hands whose fingers stand in the box, each a little more closed than the one before."""
    pivot = np.tile(HAND.palm.centre + np.array([0.001, 0, -0.095]), (HANDS, 1))
    q = np.linspace(0.3, 0.5, HANDS)[:, None] * [1.0, 0.9]
    return HandState(pivot, np.tile([1.0, 0, 0, 0], (HANDS, 1)), q)


def projection() -> Projection:
    obj = DeviceObject.create(AT_ORIGIN, "cpu", samples=object_samples(AT_ORIGIN, 500), phong_alpha=0.0, cell=0.005)
    points = sample_surface(HAND, 400)
    model = Model.create(DeviceHand.create(HAND, "cpu"), obj, points, points, LossOptions())
    return Projection(model, Data(model, HANDS), ProjectionOptions())


def equations_of(state: HandState) -> Projection:
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
    posture = posture_of(HAND, AT_ORIGIN, state[b : b + 1])
    poses = body_poses(HAND, posture.hand_pose, posture.joint_positions)[0]
    poses[:, :3] -= AT_ORIGIN.centre_of_mass
    rows = np.zeros((count, 6 + HAND.dofs))
    rows[:, 6:] = generalized_forces(HAND, poses, body, point, direction[:, None])[:, 0]
    both = other >= 0
    rows[both, 6:] -= generalized_forces(HAND, poses, other[both], point[both], direction[both, None])[:, 0]
    rows[~both, :3] = direction[~both]
    rows[~both, 3:6] = np.cross(point[~both] - state.pivot[b], direction[~both])
    return rows.T @ (weight[:, None] * rows), rows.T @ (weight * value), count


def test_the_equations_are_those_of_the_residuals() -> None:
    state = pressing()
    found = equations_of(state)
    for b in range(HANDS):
        matrix, vector, count = equations(found, state, b)
        assert count > 10
        lower = np.tril(found.matrix.numpy()[b] / kernels.FIXED)
        np.testing.assert_allclose(lower, np.tril(matrix), atol=STEP_M * count)
        np.testing.assert_allclose(found.vector.numpy()[b] / kernels.FIXED, vector, atol=1e-9 * count)


def test_a_step_solves_them() -> None:
    state = pressing()
    found = equations_of(state)
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
        np.testing.assert_allclose(moved.pivot[b], state.pivot[b] + step[:3], atol=STEP_M)
        np.testing.assert_allclose(moved.rotation[b], turned, atol=STEP_M)
        q = np.clip(state.q[b] + step[6:], HAND.lower, HAND.upper)
        np.testing.assert_allclose(moved.q[b], q, atol=10 * STEP_M)


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
    return pregrasp(HAND, AT_ORIGIN, grasp)


def test_replayed_graphs_give_the_hands_of_plain_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, plainly_opened = planned(), opened()
    replayed = replayed_graphs(monkeypatch)
    forbid_the_host(monkeypatch)
    check_same(plain.state, planned().state)
    while_planning, reopened = len(replayed), opened()
    assert 0 < while_planning < len(replayed)
    np.testing.assert_array_equal(plainly_opened.joint_positions, reopened.joint_positions)
    np.testing.assert_array_equal(plainly_opened.hand_pose, reopened.hand_pose)
