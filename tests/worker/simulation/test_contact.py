"""The contact kernels against the float64 reference, the physics they must keep, and points that must not touch."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh

from graspd.service.model.contact_region import parse_region
from graspd.service.model.errors import InputError
from graspd.studies.stability.gradients import SOLVERS, reference_gradient, run_kernel
from graspd.worker.hands.digits import Part
from graspd.worker.objects.region import ContactRegion
from graspd.worker.simulation import reference
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.model import (
    ANYWHERE,
    NEAR_GAP,
    NO_CONTACT_M,
    AllowedContacts,
    LossOptions,
    initial_motions,
)
from graspd.worker.simulation.projection import Projection, ProjectionOptions
from graspd.worker.simulation.record import record_evaluation
from graspd.worker.simulation.reference import Contacts, World
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
    for name in ("direct", "jacobi"):
        end, _, _ = run(name, balanced, WORLD)
        np.testing.assert_allclose(end[0], 0, atol=1e-8)
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


def test_solvers_without_limits_on_contacts_refuse_them() -> None:
    with pytest.raises(InputError, match="jacobi allows contact anywhere: use direct"):
        rig(HAND, BOX, capacity=1, options=LossOptions(contact_solver="jacobi"), allowed=LEFT)
