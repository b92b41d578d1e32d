"""Types of grasps: patterns of contacts on a plate, a cylinder and a sphere in closed form, and measured grasps."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from graspd.exchange.inputs import load_case
from graspd.service.model.grasp_types import TAXONOMY
from graspd.service.model.metrics import GraspType
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.surface import sample_surface
from graspd.worker.quality.grasp_type import RULES, ContactPattern
from graspd.worker.quality.table import measure
from tests.worker.models import object_from_mesh, two_finger_hand
from tests.worker.quality.helpers import grasp_set, pad_hand, posture


def pattern(normals: list[tuple[float, float, float]], width: float = 0.05, **how: object) -> ContactPattern:
    """Contacts of a thumb and fingers at `normals` on a solid `width` wide; a digit without a normal is clear."""
    normal = np.zeros((1, 5, 3))
    normal[0, : len(normals)] = np.array(normals) / np.linalg.norm(normals, axis=1, keepdims=True)
    wraps, by_side = (np.isin(np.arange(5), how.get(name, ()))[None] for name in ("wraps", "by_side"))
    touches, palm = np.linalg.norm(normal, axis=-1) > 0, np.array([bool(how.get("palm"))])
    return ContactPattern(palm, touches, wraps, by_side, 0.5 * width * normal, normal)


def around(*degrees: float, lift: float = 0.0) -> list[tuple[float, float, float]]:
    """Normals around a cylinder's axis z, alternately lifted towards -z and +z."""
    return [(np.cos(a), np.sin(a), lift * (-1) ** k) for k, a in enumerate(np.deg2rad(degrees).tolist())]


def plate(fingers: int) -> list[tuple[float, float, float]]:
    return [(0, 0, 1.0), *[(0, 0, -1.0)] * fingers]


FIVE = (0, 72, 144, 216, 288)
#: The order of digits is thumb, index, middle, ring, little.
CASES = {
    "palmar_pinch": pattern(plate(1)),
    "prismatic_2_finger": pattern(plate(2)),
    "prismatic_3_finger": pattern(around(0, 175, 180, 185)),
    "prismatic_4_finger": pattern(plate(4)),
    "tripod": pattern(around(0, 120, 240)),
    "quadpod": pattern(around(0, 100, 180, 260, lift=0.5)),
    "precision_disk": pattern(around(*FIVE)),
    "precision_sphere": pattern(around(*FIVE, lift=1.0)),
    "ring": pattern(around(0, 180), wraps=(0, 1)),
    "sphere_3_finger": pattern(around(0, 120, 240), wraps=(1, 2)),
    "sphere_4_finger": pattern(around(0, 90, 180, 270), wraps=(1, 2)),
    "small_diameter": pattern(plate(4), 0.02, palm=True),
    "medium_wrap": pattern(plate(4), 0.04, palm=True),
    "large_diameter": pattern(plate(4), 0.08, palm=True),
    "power_disk": pattern(around(*FIVE), palm=True),
    "power_sphere": pattern(around(*FIVE, lift=1.0), palm=True),
    "lateral": pattern(plate(1), by_side=(1,)),
}


@pytest.mark.parametrize("name", TAXONOMY)
def test_a_pattern_has_its_type_of_the_taxonomy_and_no_other(name: str) -> None:
    seen = CASES[name]
    fitting = {kind for kind, rule in RULES.items() if rule.applies(seen)[0]}
    broad = {GraspType(seen.types[0]).name.lower()}
    assert fitting == {name} | broad | ({"pinch"} if name == "palmar_pinch" else set())
    assert seen.taxonomy().tolist() == [TAXONOMY[name]]


def test_numbers_are_those_of_the_published_taxonomy() -> None:
    """Feix et al. 2016: 33 types, of which some have no rule by contacts."""
    numbers = {"medium_wrap": 3, "palmar_pinch": 9, "tripod": 14, "lateral": 16, "quadpod": 27, "ring": 31}
    assert numbers.items() <= TAXONOMY.items() and len(set(TAXONOMY.values())) == len(TAXONOMY)
    assert set(TAXONOMY) == set(RULES) - {"power", "precision", "pinch"}


@pytest.mark.parametrize(
    ("seen", "kind", "digits"),
    [
        (pattern([(0, 0, 1)]), GraspType.NONE, 0b1),
        (pattern(plate(1), by_side=(0, 1)), GraspType.LATERAL, 0b11),
        (pattern(plate(2), by_side=(1,), wraps=(1,)), GraspType.PRECISION, 0b111),
    ],
)
def test_oppositions_depend_on_palm_sides_and_wrapping_digits(seen: ContactPattern, kind: int, digits: int) -> None:
    assert (seen.types.tolist(), seen.digits.tolist()) == ([kind], [digits])
    assert not RULES["lateral"].applies(seen)[0], "the thumb of a lateral grasp presses with its pad"
    fingers = replace(seen, touches=np.roll(seen.touches, 1, axis=1))
    assert not fingers.taxonomy()[0] and fingers.digits == 2 * digits, "without the thumb"


def test_contacts_are_averaged_by_area_over_the_points_within_two_millimetres() -> None:
    hand = two_finger_hand()
    points = sample_surface(hand, 400)
    normal = np.where(points.body[:, None] == 1, [1.0, 0, 0], [-1.0, 0, 0])
    place = 0.02 * normal + np.outer(np.arange(len(points)) % 2, [0, 0, 0.01])
    near = np.isin(points.body, (1, 2)) & (points.position[:, 2] > 0.06)
    found = SimpleNamespace(distance=np.where(near, 0.001, 0.0021)[None], normal=normal[None], closest=place[None])
    seen = ContactPattern.of(SimpleNamespace(hand=hand, points=points), found, np.array([[0.005, 0.001, -0.001]]))
    assert (seen.palm[0], seen.touches[0].tolist(), seen.wraps.any()) == (False, [True, True], False)
    assert np.abs(seen.normal[0, :, 0]) == pytest.approx([1.0, 1.0]) and seen.width == pytest.approx(0.04, abs=1e-3)
    ours = near & (points.body == 1)
    expected = np.average(place[ours], axis=0, weights=points.area[ours])
    assert np.abs(seen.place[0] - expected).max(axis=1).min() < 1e-12


def hand_on(radius: float, at: float, q: np.ndarray) -> int:
    """Type of a grasp of an Allegro hand with dofs q (16,) of a ball that lies before its palm, `at` [m] from it."""
    hand = hand_from_path("allegro")
    centre = hand.palm.centre + hand.palm.approach * (at + radius)
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=3, radius=radius))
    grasp = grasp_set(Posture(np.array([[*-centre, 1, 0, 0, 0]]), hand.expand(q[None])))
    return int(measure(hand, ball, grasp)["quality/grasp_type"][0])


def test_a_ball_is_held_in_a_power_grasp_in_the_palm_or_by_pads() -> None:
    hand = hand_from_path("allegro")
    closed = np.where(hand.closing != 0, hand.lower + 0.7 * hand.span, hand.preshape)
    assert hand_on(0.03, 0.0, closed) == GraspType.POWER and hand_on(0.01, 0.5, hand.preshape) == GraspType.NONE
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.03))
    # Pads stand 65 mm from the middle and slide inwards by 65 - 30 - 5 mm.
    found = measure(pad_hand(), ball, grasp_set(posture(((0, 0, 0), (0.065, 0.065)))))
    told = [found[f"quality/{name}"].tolist() for name in ("grasp_type", "digits", "taxonomy_type")]
    assert told == [[GraspType.PRECISION], [0b11], [TAXONOMY["palmar_pinch"]]]


def test_fingers_that_touch_by_their_sides_are_a_lateral_grasp() -> None:
    """A thin card between two straight fingers: what they touch it with looks along their axes of flexion."""
    hand = hand_from_path("allegro")
    straight = np.clip(np.zeros(hand.dofs), hand.lower, hand.upper)
    poses = body_poses(hand, np.array([[0.0, 0, 0, 1, 0, 0, 0]]), hand.expand(straight[None]))[0]
    first, second = (poses[body, :3] for body in hand.fingertips[:2])
    middle, across = (first + second) / 2, second - first
    size = np.full(3, 0.02)
    size[np.argmax(np.abs(across))] = np.linalg.norm(across) - 2 * 0.0135
    card = object_from_mesh(trimesh.creation.box(size))
    pose = np.array([[*-middle, 1, 0, 0, 0]])
    found = measure(hand, card, grasp_set(Posture(pose, hand.expand(straight[None]))))
    assert found["quality/contact_links"][0] >= 2
    told = [found[f"quality/{name}"].tolist() for name in ("grasp_type", "digits", "taxonomy_type")]
    assert told == [[GraspType.LATERAL], [0b110], [0]], "index and middle finger, so no thumb presses"


def test_published_fingertip_grasps_are_precision_grasps(shared_data) -> None:
    """FRoGGeR plans with four fixed points on the fingertips, so whoever plans nothing else holds nothing else."""
    case = load_case(shared_data / "reference_grasps" / "frogger_allegro" / "056_tennis_ball.json")
    some = case.grasps.take(np.arange(6))
    types = measure(case.hand, case.obj, some, thresholds_m=[0.005])["quality/grasp_type"]
    assert (types == GraspType.PRECISION).all()
