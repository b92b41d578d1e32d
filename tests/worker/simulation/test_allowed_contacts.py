"""Points that must not touch: no force at them, and a clearance from the object instead of contact."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from graspd.service.model.contact_region import parse_region
from graspd.service.model.errors import InputError
from graspd.studies.stability.gradients import run_kernel
from graspd.worker.hands.digits import Part
from graspd.worker.objects.region import ContactRegion
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.model import ANYWHERE, NEAR_GAP, NO_CONTACT_M, AllowedContacts, LossOptions
from graspd.worker.simulation.projection import Projection, ProjectionOptions
from graspd.worker.simulation.record import record_evaluation
from graspd.worker.simulation.reference import Contacts
from tests.worker.models import object_from_mesh, two_finger_hand
from tests.worker.simulation.rigs import rig, still
from tests.worker.simulation.test_contact import WORLD, ring

HAND = two_finger_hand()
AT = np.array([0.1, -0.2, 0.3])
#: A box away from the origin, so that a region in its frame differs from one about its centre of mass.
BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05), trimesh.transformations.translation_matrix(AT)))
#: With this band, all points of the hand are candidates, so that two models list the same ones.
EVERY = LossOptions(band=0.5, pull=0.01, leak=0.1)
PENALTY = 2.0
LEFT = AllowedContacts(np.array([Part.WHOLE, Part.NONE, Part.WHOLE], np.int32))
#: single precision of coordinates around 0.1 m.
SINGLE = 2e-7


def pressing(close: float = 0.45) -> HandState:
    """Both fingers in the box."""
    return HandState(np.array([[0.001, 0, -0.095]]), np.array([[1.0, 0, 0, 0]]), np.full((1, 2), close))


def evaluated(allowed: AllowedContacts, options: LossOptions = EVERY, state: HandState | None = None) -> dict:
    """Contacts (N,) of one hand, with its loss, gradient and depth."""
    model, data = rig(HAND, BOX, capacity=1, options=options, allowed=allowed, alpha=0.0)
    schedule = still(dilation=1e-3)
    data.set_schedule(replace(schedule, penetration=np.full(1, PENALTY)))
    data.set_state(pressing() if state is None else state)
    record_evaluation(model, data).run()
    found = {name: getattr(data.contacts, name).numpy()[0] for name in ("body", "point", "normal", "distance")}
    found |= {name: getattr(data.contacts, name).numpy()[0] for name in ("weight", "gradient", "near")}
    found |= {name: getattr(data.contacts, name).numpy()[0] for name in ("count", "near_count")}
    assert found["count"] == model.count == len(found["body"])
    return found | {"loss": data.loss.numpy()[0], "step": data.gradient.numpy()[0], "depth": data.depths.points.numpy()}


def test_limits_that_allow_everything_change_no_bit() -> None:
    free, limited = evaluated(ANYWHERE), evaluated(AllowedContacts(np.full(3, Part.WHOLE, np.int32)))
    limited["near"], free["near"] = (one["near"][: one["near_count"]] for one in (limited, free))
    for name, values in free.items():
        np.testing.assert_array_equal(limited[name], values, err_msg=name)
    assert (free["weight"] > 0).all() and free["near_count"] > 0 and np.abs(free["step"]).max() > 0


def test_points_of_an_excluded_finger_keep_the_clearance_and_are_no_contacts() -> None:
    free, limited = evaluated(ANYWHERE), evaluated(LEFT)
    left = free["body"] == 1
    np.testing.assert_array_equal(limited["weight"], np.where(left, -1, 1) * free["weight"])
    shift = free["distance"] - limited["distance"]
    assert shift == pytest.approx(np.where(left, NO_CONTACT_M, 0.0), abs=SINGLE)
    near = limited["near"][: limited["near_count"]]
    assert set(near) == set(free["near"][: free["near_count"]]) - set(np.flatnonzero(left)) and len(near)
    assert (limited["gradient"][left] == 0).all() and np.abs(free["gradient"][left]).max() > 0
    # The clearance counts as penetration. Its penalty w |w_i| rho_i^2 alone turns the excluded finger about y.
    assert limited["depth"] == pytest.approx(-limited["distance"].min(), abs=SINGLE)
    inside = left & (limited["distance"] < 0)
    arm = (limited["point"] - pressing().pivot - HAND.origin[1, :3])[inside]
    force = 2 * PENALTY * np.abs(free["weight"] * limited["distance"])[inside, None] * -limited["normal"][inside]
    assert inside.sum() >= 3
    assert limited["step"][6] == pytest.approx((force * np.cross([0, 1, 0], arm)).sum(), rel=1e-3)


def test_contact_forces_are_those_of_the_allowed_points_alone() -> None:
    some, more = ring(np.random.default_rng(1)), ring(np.random.default_rng(2), count=9)
    both = Contacts(
        *(
            np.concatenate([getattr(c, name) for c in (some, more)])
            for name in ("points", "normals", "distances", "weights")
        )
    )
    guarded = replace(both, weights=np.where(np.arange(33) < 24, both.weights, -both.weights))
    alone, found = (run_kernel("direct", given, WORLD, near_gap=NEAR_GAP, lane=5) for given in (some, guarded))
    for one, other in zip(alone[:2], found[:2], strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(found[2], np.append(alone[2], np.zeros(9)))


def test_points_that_must_not_touch_are_not_attracted() -> None:
    """Neither by the term of the planner, nor by the control without simulation."""
    apart = HandState(np.array([[0.0, 0, -0.15]]), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 2)))
    options = replace(EVERY, simulate=False)
    free, limited = (evaluated(one, options, apart) for one in (ANYWHERE, LEFT))
    left = free["body"] == 1
    assert (free["distance"] > NO_CONTACT_M).all()
    assert (limited["gradient"][left] == 0).all() and (free["gradient"][left] > 0).all()
    np.testing.assert_array_equal(limited["gradient"][~left], free["gradient"][~left])
    range_only = evaluated(AllowedContacts(np.full(3, Part.NONE, np.int32)), replace(options, pull=0.0), apart)["step"]
    assert limited["step"][6] == range_only[6] != free["step"][6]


@pytest.mark.parametrize(("touch", "avoid"), [("x > 0.1", ""), ("", "x > 0.1"), ("z < 0.28", "x > 0.11, z < 9")])
def test_points_are_guarded_by_the_nearest_place_on_the_object(touch: str, avoid: str) -> None:
    region = ContactRegion(*(np.array(parse_region(text)) if text else None for text in (touch, avoid)))
    free, limited = evaluated(ANYWHERE), evaluated(AllowedContacts(region=region))
    place = free["point"] - free["distance"][:, None] * free["normal"] + BOX.centre_of_mass
    clear = np.abs(place[:, [0, 0, 2]] - [0.1, 0.11, 0.28]).min(axis=1) > 1e-5
    np.testing.assert_array_equal((limited["weight"] > 0)[clear], region.contains(place)[clear])
    assert 0 < (limited["weight"] > 0).sum() < len(place)


def test_the_projection_moves_an_excluded_finger_out_to_the_clearance() -> None:
    found = {}
    for allowed in (ANYWHERE, LEFT):
        model, data = rig(HAND, BOX, capacity=1, allowed=allowed, alpha=0.0)
        moved, depth = Projection(model, data, ProjectionOptions()).run(pressing(0.4), 60)
        distance, body = (evaluated(ANYWHERE, state=moved)[name] for name in ("distance", "body"))
        found[allowed is LEFT] = [distance[body == finger].min() for finger in (1, 2)]
        assert depth[0] < 2e-4  # of points of the hand in the object or its clearance
    assert np.abs(found[False]).max() < 2e-3, "both fingers touch"
    assert found[True][0] == pytest.approx(NO_CONTACT_M, abs=7e-4) and abs(found[True][1]) < 2e-3


def test_solvers_without_limits_on_contacts_refuse_them() -> None:
    with pytest.raises(InputError, match="jacobi allows contact anywhere: use direct"):
        rig(HAND, BOX, capacity=1, options=LossOptions(contact_solver="jacobi"), allowed=LEFT)
