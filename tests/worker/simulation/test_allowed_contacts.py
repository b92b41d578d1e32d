"""Points that must not touch: no force at them, and a clearance from the object instead of contact."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
import warp as wp

from graspd.service.model.contact_region import parse_region
from graspd.service.model.errors import InputError
from graspd.studies.stability.gradients import run_kernel
from graspd.worker.hands.digits import Part
from graspd.worker.objects.region import ContactRegion
from graspd.worker.simulation.data import HandState, allocate_contacts
from graspd.worker.simulation.kernels import projection
from graspd.worker.simulation.model import ANYWHERE, NEAR_GAP, NO_CONTACT_M, AllowedContacts, LossOptions
from graspd.worker.simulation.projection import Projection, ProjectionOptions
from graspd.worker.simulation.record import record_evaluation
from graspd.worker.simulation.reference import Contacts
from tests.worker.models import object_from_mesh, two_finger_hand
from tests.worker.simulation.rigs import rig, still
from tests.worker.simulation.test_contact import WORLD, ring

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
    region = ContactRegion(*(np.array(parse_region(text)) if text else None for text in (touch, avoid)))
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
    wp.launch(projection.point_residuals, (1, 1), inputs=inputs, outputs=[step.residuals], device="cpu")
    assert step.residuals.body.numpy()[0, : step.residuals.count.numpy()[0]].tolist() == [2]


def test_solvers_without_limits_on_contacts_refuse_them() -> None:
    with pytest.raises(InputError, match="jacobi allows contact anywhere: use direct"):
        rig(HAND, BOX, capacity=1, options=LossOptions(contact_solver="jacobi"), allowed=LEFT)
